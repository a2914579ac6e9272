"""The studies: each asks one question about the same networks and answers it with a table."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from vergence_models.evaluate import COLUMNS, figures
from vergence_models.evaluation.classical import classical_methods, patchmatch_without_memory
from vergence_models.evaluation.methods import (
    Method,
    counted_start,
    with_pose_noise,
    without_poses,
)
from vergence_models.evaluation.metric_accumulator import MetricAccumulator, settled_frame
from vergence_models.studies import paper
from vergence_models.studies.bench import Bench, step_times_ms
from vergence_models.studies.findings import (
    cold_start_findings,
    loss_pct,
    main_findings,
    noise_findings,
    warp_findings,
)
from vergence_models.studies.footage import SPEEDS, FootageGroup
from vergence_models.studies.learning import learning_curves
from vergence_models.studies.networks import StudiedNetwork
from vergence_models.studies.tables import EPE_COLUMNS, TIME_COLUMNS, Curve, Table, TableRow

NOISE_DEG, NOISE_M = 0.3, 0.001  # pose errors at noise level 1
REPORTED_FRAMES = (1, 2, 3, 5, 10, 15, 20, 30)
WARP_SPEEDS = (1, 6)

Study = Callable[[Bench], Table]


def every_method(bench: Bench) -> list[Method]:
    """The main table's: single frame and warm at every count there is, SGBM and PatchMatch."""
    methods = []
    for studied in bench.networks:
        methods += studied.single_frame_methods() + studied.warm_methods()
    return [*methods, *classical_methods(), patchmatch_without_memory()]


def one_iteration(bench: Bench) -> list[tuple[StudiedNetwork, Method]]:
    """The paper's own way: one warm iteration a frame."""
    return [
        (studied, studied.warm_methods()[0])
        for studied in bench.networks
        if studied.warm[:1] == (1,)
    ]


def training_of(networks: Sequence[StudiedNetwork]) -> list[str]:
    """The training of all networks with a row; a run whose counts all have graphs has none."""
    return [each.training.words for each in networks if each.warm or each.single_frame]


def times(bench: Bench) -> Table:
    """Measure the time of a frame."""
    found = step_times_ms(every_method(bench), rounds=bench.settings.timed)
    rows = [
        TableRow(label, {"ms": round(ms, 2), "fps": round(1e3 / ms, 3), "cpu_ms": round(cpu_ms, 2)})
        for label, (ms, cpu_ms) in found.items()
    ]
    return Table(
        name="times",
        title="Time of a frame",
        text="Medians for a 640x480 frame, batch 1, on this machine's CPU; all methods take turns "
        "in one run, so what else the machine does hits all alike. CPU time counts every thread. "
        "Graphs run under onnxruntime, rows that say PyTorch under PyTorch.",
        columns=TIME_COLUMNS,
        rows=rows,
        training=[],
    )


def main_table(bench: Bench) -> Table:
    """Every method at walking pace."""
    group = bench.clips()
    found = bench.accumulators(group, every_method(bench))
    return Table(
        name="main",
        title="Main table",
        text=f"On {group.words}. EPE and TEPE (flicker along the true motion) in px; times are of "
        "a 640x480 frame.",
        columns=EPE_COLUMNS | {"tepe": "TEPE"} | TIME_COLUMNS,
        rows=rows_of(found),
        training=training_of(bench.networks),
        findings=main_findings(bench.networks, found),
        paper=paper.MAIN,
        paper_note=paper.SOURCE,
    )


def warp_ablation(bench: Bench) -> Table:
    """Compare one network with its state warped, kept in place, and discarded."""
    variants: dict[str, Method] = {}
    for studied, warm in one_iteration(bench):
        if studied.warps:
            variants[f"{studied.name}, state moved"] = warm
        variants[f"{studied.name}, state not moved"] = not_moved(studied, warm)
        for count, method in zip(
            studied.single_frame[-1:], studied.single_frame_methods()[-1:], strict=True
        ):
            start = counted_start(studied.network, count)
            variants[f"{studied.name}, no state, {start}"] = method
    cells: dict[str, dict[str, float]] = {label: {} for label in variants}
    for speed in WARP_SPEEDS:
        found = bench.accumulators(bench.clips_at(speed), list(variants.values()))
        for label, method in variants.items():
            cells[label][f"{speed}x"] = epe(found[method.label])
    return Table(
        name="warp",
        title="Warp or no warp, at 1x and 6x",
        text=f"EPE in px on {bench.clips_at(1).words}; one warm iteration a frame. *Not moved*: "
        "the same weights see no camera motion, which leaves the state in place. "
        "*No state*: every frame cold.",
        columns={"1x": "1x", "6x": "6x", "loss": "loss at 6x, %"},
        rows=[
            TableRow(label, values | {"loss": loss_pct(values)}) for label, values in cells.items()
        ],
        training=training_of(bench.networks),
        findings=warp_findings(cells),
        paper=[
            TableRow(row.label, row.values | {"loss": loss_pct(row.values)}) for row in paper.WARP
        ],
        paper_note=paper.SOURCE,
    )


def not_moved(studied: StudiedNetwork, method: Method) -> Method:
    """The same method without poses; a network without warp ignores them anyway."""
    return method.with_input("state not moved", without_poses) if studied.warps else method


def movement_speed(bench: Bench) -> Table:
    """From a calm head to a violent one."""
    methods = []
    for studied, warm in one_iteration(bench):
        methods += [warm, not_moved(studied, warm)]
    cells: dict[str, dict[str, float]] = {method.label: {} for method in methods}  # each once
    for speed in SPEEDS:
        for label, accumulator in bench.accumulators(bench.clips_at(speed), methods).items():
            cells[label][f"{speed}x"] = epe(accumulator)
    return Table(
        name="speed",
        title="Movement speed, 1x to 20x",
        text=f"EPE in px on {bench.clips_at(1).words}. A calm head's path (about 10 degrees and 10 "
        "cm a second) is played back faster. What has no past is the same at every speed, and left "
        "out.",
        columns={f"{speed}x": f"{speed}x" for speed in SPEEDS},
        rows=[TableRow(label, values) for label, values in cells.items()],
        training=training_of(bench.networks),
        paper=paper.SPEED,
        paper_note=paper.SOURCE,
        curves=[
            Curve(label, [float(s) for s in SPEEDS], list(values.values()))
            for label, values in cells.items()
        ],
        x_label="playback speed",
    )


def pose_noise(bench: Bench, levels: Sequence[int] = range(11)) -> Table:
    """The tracker's errors, from none to far beyond any tracker."""
    cells: dict[str, dict[str, float]] = {}
    for studied, warm in one_iteration(bench):
        if not studied.warps:
            continue
        reported = {level: with_noise_level(warm, level) for level in levels}
        found = bench.accumulators(bench.clips_at(1), list(reported.values()))
        cells[warm.label] = {str(k): epe(found[method.label]) for k, method in reported.items()}
    return Table(
        name="noise",
        title="Noise of the poses, levels 0 to 10",
        text=f"EPE in px on {bench.clips_at(1).words}. At level k every motion from one frame "
        f"to the next is off by k x {NOISE_DEG} degrees and k x {1e3 * NOISE_M:g} mm, in random "
        "directions that are the same at each level. Networks without a warp see no poses.",
        columns={str(level): str(level) for level in levels},
        rows=[TableRow(label, values) for label, values in cells.items()],
        training=training_of(bench.networks),
        findings=noise_findings(cells),
        paper=paper.NOISE,
        paper_note=paper.SOURCE,
        curves=[
            Curve(label, [float(k) for k in levels], list(values.values()))
            for label, values in cells.items()
        ],
        x_label="noise level",
    )


def with_noise_level(method: Method, level: int) -> Method:
    if level == 0:
        return method
    return method.with_input(
        f"noise level {level}",
        lambda footage: with_pose_noise(footage, deg=level * NOISE_DEG, m=level * NOISE_M),
    )


def cold_start(bench: Bench) -> Table:
    """Measure the frames that a stream takes to settle."""
    methods = []
    for studied, warm in one_iteration(bench):
        methods += [warm, *studied.single_frame_methods()[-1:]]
        if studied.cold > 1:
            methods.append(studied.started_with(1))
    group = bench.clips()
    found = bench.accumulators(group, methods)
    curves = {label: accumulator.epe_by_frame() for label, accumulator in found.items()}
    reported = [frame for frame in REPORTED_FRAMES if frame <= group.frames]
    rows = []
    for label, epes in curves.items():
        values = {str(frame): epes[frame - 1] for frame in reported if frame <= len(epes)}
        settled = settled_frame(epes)
        rows.append(TableRow(label, values if settled is None else values | {"settled": settled}))
    cold = ", ".join(f"{c.name} {c.cold}" for c, _ in one_iteration(bench))
    return Table(
        name="cold",
        title="Cold start",
        text=f"EPE in px by the number of the frame, on {group.words}. *Settled*: the first frame "
        "within 10 % of the mean over the later half. Iterations on the first frame, where a row "
        f"does not say: {cold}.",
        columns={str(frame): str(frame) for frame in reported} | {"settled": "settled by"},
        rows=rows,
        training=training_of(bench.networks),
        findings=cold_start_findings([row for row in rows if "every frame" not in row.label]),
        paper=paper.COLD_START,
        paper_note=paper.SOURCE,
        curves=curves_of(curves),
        x_label="frame",
    )


def curves_of(epe_by_frame: dict[str, list[float]]) -> list[Curve]:
    """Curves over the number of the frame; none of lone pairs."""
    return [
        Curve(label, [float(k + 1) for k in range(len(epes))], epes)
        for label, epes in epe_by_frame.items()
        if len(epes) > 1
    ]


def on_data(bench: Bench, group: FootageGroup, name: str) -> Table:
    """The main table on sequences or pairs from disk."""
    found = bench.accumulators(group, every_method(bench))
    return Table(
        name=name,
        title=f"On `{group.name}`",
        text=f"On {group.words}.",
        columns=EPE_COLUMNS | {"tepe": "TEPE", "settled": "settled by"} | TIME_COLUMNS,
        rows=rows_of(found),
        training=training_of(bench.networks),
        findings=main_findings(bench.networks, found),
        curves=curves_of(
            {label: accumulator.epe_by_frame() for label, accumulator in found.items()}
        ),
        x_label="frame",
    )


def kitti(bench: Bench, group: FootageGroup) -> Table:
    """The paper's protocol for KITTI odometry: EPE, and the errors that few pixels exceed."""
    found = bench.accumulators(group, every_method(bench))
    tail = {key: COLUMNS[key] for key in ("p99", "p97", "p95")}
    return Table(
        name="kitti",
        title=f"KITTI odometry: `{group.name}`",
        text=f"On {group.words}. Bad 1, 3 and 5 % as the paper means them: the error in px that "
        "only so many of the pixels exceed, the 99th, 97th and 95th percentile.",
        columns={"epe": "EPE"} | tail | TIME_COLUMNS,
        rows=rows_of(found),
        training=training_of(bench.networks),
        paper=paper.KITTI,
        paper_note=paper.SOURCE,
    )


def rows_of(found: dict[str, MetricAccumulator]) -> list[TableRow]:
    """All figures but the times, which `times` measures on frames of one size."""
    return [
        TableRow(
            label, {k: v for k, v in figures(accumulator).items() if k not in ("cpu_ms", "wall_ms")}
        )
        for label, accumulator in found.items()
    ]


def epe(accumulator: MetricAccumulator) -> float:
    return accumulator.summary()["epe"]


STUDIES: dict[str, Study] = {
    "main": main_table,
    "warp": warp_ablation,
    "speed": movement_speed,
    "noise": pose_noise,
    "cold": cold_start,
    "times": times,
    "training": learning_curves,
}
