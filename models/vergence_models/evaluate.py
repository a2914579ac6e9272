"""``python -m vergence_models.evaluate --json FILE``: errors of a model, of SGBM and PatchMatch.

    python -m vergence_models.evaluate --json out.json --data vergence:DIR --pool pool/val
    python -m vergence_models.evaluate --no-evidence

Every method sees the same frames in the same run. Prints Markdown (also written beside the JSON),
and with ``--plots`` draws cold-start curves and the calibration of sigma. ``--no-evidence`` adds
the first model's confidence in images that do not show the disparity.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from rich.progress import Progress

from vergence_models.data.pool import ClipPool
from vergence_models.evaluation.classical import classical_methods
from vergence_models.evaluation.direct_labels import End, label_ends
from vergence_models.evaluation.evidence import SURE, Doubt, doubts_of
from vergence_models.evaluation.methods import (
    Method,
    single_frame_method,
    warm_method,
    with_pose_noise,
    without_poses,
)
from vergence_models.evaluation.metric_accumulator import MetricAccumulator, settled_frame
from vergence_models.evaluation.metrics import SHARES_PCT
from vergence_models.evaluation.number_format import cell, decimals
from vergence_models.evaluation.stepping import (
    Footage,
    OnnxNetwork,
    Prediction,
    SteppedNetwork,
    footage_from_clip,
    footage_from_source,
)
from vergence_models.progress import no_progress, progress_bar
from vergence_models.training.validation import filmed
from vergence_proto.datasets import DatasetError, find_sources, open_source
from vergence_proto.model_io import ManifestError, folder_of_model, user_models_dir

WEIGHTS = Path(__file__).parent / "weights"

Results = dict[str, dict[str, MetricAccumulator]]  # group -> method -> its figures


def methods_for(network: SteppedNetwork, *, thorough: bool) -> list[Method]:
    """The network warm and cold; ``thorough`` adds no motion and noisy motion."""
    name, fewest, most = network.card.name, min(network.card.graphs), max(network.card.graphs)
    if not network.card.recurrent:  # poses do not matter to it either
        return [single_frame_method(network, name, most)]
    warm = warm_method(network, name, fewest, cold=most)
    methods = [warm, single_frame_method(network, name, most)]
    if thorough:
        methods += [
            warm.with_input("no poses", without_poses),
            warm.with_input(
                "poses off by 0.3 deg and 1 mm",
                lambda footage: with_pose_noise(footage, deg=0.3, m=0.001),
            ),
        ]
    return methods


def footage_on_disk(sources: list[str]) -> Iterator[Footage]:
    """Each source, as ``find_sources`` lists them. Raises DatasetError."""
    for source in sources:
        yield footage_from_source(open_source(source))


def footage_of_pool(folder: Path, clips: int) -> Iterator[Footage]:
    """The first clips of a pool, with camera flaws. Raises FileNotFoundError."""
    pool = ClipPool(folder)
    for index in range(min(clips, len(pool))):
        clip = filmed(pool, range(index, index + 1))
        yield footage_from_clip(clip, 0, f"{folder.name}/{index}")


def gather(sources: list[str], pool: list[Path], clips: int) -> Iterator[tuple[str, Footage]]:
    """(group, footage): each source on disk is a group of its own, the clips of a pool are one."""
    for footage in footage_on_disk(sources):
        yield footage.name, footage
    for folder in pool:
        for footage in footage_of_pool(folder, clips):
            yield f"pool {folder.name}", footage


def evaluate(
    methods: list[Method],
    footages: Iterator[tuple[str, Footage]],
    *,
    progress: Progress | None = None,
    count: int | None = None,
) -> Results:
    """Group -> method -> its figures; ``count`` is the number of footages, for the progress bar."""
    progress = progress or no_progress()
    results: Results = {}
    whole = progress.add_task("sequences", total=count, note="")
    for group, footage in footages:
        accumulators = results.setdefault(
            group, {method.label: MetricAccumulator() for method in methods}
        )
        frames = len(footage.views)
        bar = progress.add_task(footage.name, total=frames * len(methods), note="")
        for method in methods:
            progress.update(bar, note=method.label)
            accumulators[method.label].add(
                footage, _counted(method.predict(footage), partial(progress.advance, bar))
            )
        progress.remove_task(bar)
        progress.advance(whole)
        progress.console.print(_in_short(footage, methods, accumulators), soft_wrap=True)
    return results


def _counted(
    predictions: Iterator[Prediction], advance: Callable[[], None]
) -> Iterator[Prediction]:
    for prediction in predictions:
        advance()  # first: nobody asks for more after the last one
        yield prediction


def _in_short(
    footage: Footage, methods: list[Method], accumulators: dict[str, MetricAccumulator]
) -> str:
    """The errors so far of the group that the footage belongs to."""
    found = {each.label: accumulators[each.label].summary().get("epe") for each in methods}
    errors = [f"{label} {epe:.2f}" for label, epe in found.items() if epe is not None]
    return f"{footage.name}, EPE in px: {'; '.join(errors) or 'no truth'}"


COLUMNS = {
    "epe": "EPE",
    "d1": "D1 %",
    "bad2": "bad 2 %",
    "d3": "D3 %",
    "d5": "D5 %",
    "p99": "bad 1 %, px",
    "p97": "bad 3 %, px",
    "p95": "bad 5 %, px",
    "tepe": "TEPE",
    "settled": "settled by frame",
    "within_1_sigma": "in 1 sigma, %",
    "within_2_sigma": "in 2",
    "within_3_sigma": "in 3",
    "cpu_ms": "CPU ms",
}


def figures(accumulator: MetricAccumulator) -> dict[str, float]:
    """The summary, and the frame by which a start has settled."""
    settled = settled_frame(accumulator.epe_by_frame())
    return accumulator.summary() | ({} if settled is None else {"settled": settled})


def markdown(results: Results) -> str:
    """One table per group."""
    parts = []
    for group, accumulators in results.items():
        lines = [f"### {group}", "", "| method | " + " | ".join(COLUMNS.values()) + " |"]
        lines.append("|---|" + "---:|" * len(COLUMNS))
        rows = {name: figures(accumulator) for name, accumulator in accumulators.items()}
        places = {
            key: decimals(found[key] for found in rows.values() if key in found) for key in COLUMNS
        }
        for name, found in rows.items():
            cells = [cell(found.get(key), count) for key, count in places.items()]
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
        parts.append("\n".join(lines))
    return "\n\n".join(parts) + "\n"


def doubt_table(doubts: dict[str, Doubt]) -> str:
    """The confidence in images without evidence: median, and the share of pixels above SURE."""
    lines = [
        "### no evidence",
        "",
        f"| input | confidence, cold | in mid-stream | above {SURE}, cold, % | in mid-stream |",
        "|---|---:|---:|---:|---:|",
    ]
    for name, found in doubts.items():
        cells = (found.cold, found.warm, found.cold_sure_pct, found.warm_sure_pct)
        lines.append(f"| {name} | " + " | ".join(f"{value:.0f}" for value in cells) + " |")
    return "\n".join(lines) + "\n"


def as_json(results: Results) -> dict[str, object]:
    return {
        group: {
            name: {**figures(accumulator), "epe_by_frame": accumulator.epe_by_frame()}
            for name, accumulator in accumulators.items()
        }
        for group, accumulators in results.items()
    }


# Left, bottom, width and height of the two axes, as shares of the figure.
_BOXES = ((0.05, 0.13, 0.36, 0.77), (0.74, 0.13, 0.24, 0.77))


def draw_plots(results: Results, folder: Path) -> None:
    """One PNG per group: EPE against the frame's number, and the calibration of sigma."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    for group, accumulators in results.items():
        figure = plt.figure(figsize=(13, 4))
        # The names of the curves stand between the two.
        start, trust = (figure.add_axes(box) for box in _BOXES)
        ends = []
        for index, (name, accumulator) in enumerate(accumulators.items()):
            shade, epes = f"C{index}", accumulator.epe_by_frame()
            start.plot(range(1, len(epes) + 1), epes, color=shade, marker="." * (len(epes) < 2))
            if epes:
                ends.append(End(name, len(epes), epes[-1], shade))
            summary = accumulator.summary()
            reported = [summary[f"within_{s}"] for s in SHARES_PCT if f"within_{s}" in summary]
            if reported:
                trust.plot(SHARES_PCT, reported, marker=".", color=shade)
        start.set(xlabel="frame", ylabel="EPE [px]", title=group, ylim=(0, None))
        label_ends(start, ends)
        trust.plot((0, 100), (0, 100), color="0.7", linestyle=":")
        trust.set(xlabel="interval of sigma [%]", ylabel="errors inside [%]", title="calibration")
        figure.savefig(folder / f"{group.replace(' ', '_')}.png", dpi=110)
        plt.close(figure)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="vergence_models.evaluate", description=__doc__)
    parser.add_argument(
        "--weights", type=Path, help="folder with a manifest; default: as vergence serve"
    )
    parser.add_argument("--model", nargs="+", default=["lite"], help="also of vergence models add")
    parser.add_argument("--data", nargs="*", default=[], help="KIND:PATH, as vergence run takes it")
    parser.add_argument("--pool", type=Path, nargs="*", default=[], help="held-out clips")
    parser.add_argument("--clips", type=int, default=32, help="clips of each pool")
    parser.add_argument("--thorough", action="store_true", help="also without and with noisy poses")
    parser.add_argument("--no-evidence", action="store_true", help="also blank images and the like")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--json", type=Path, help="written with a .md of the same name beside it")
    parser.add_argument("--plots", type=Path, help="folder for PNGs")
    given = parser.parse_args(arguments)
    if not (given.data or given.pool or given.no_evidence):
        parser.error("nothing to evaluate on: name --data KIND:PATH, --pool DIR or --no-evidence")
    if given.json:
        given.json.parent.mkdir(parents=True, exist_ok=True)
    try:
        # Before the graphs are loaded, which takes seconds.
        sources = [source for spec in given.data for source in find_sources(spec)]
        folders = [given.weights] if given.weights else [WEIGHTS, user_models_dir()]
        networks = [
            OnnxNetwork(folder_of_model(name, folders), name, threads=given.threads)
            for name in dict.fromkeys(given.model)
        ]
        methods = [m for each in networks for m in methods_for(each, thorough=given.thorough)]
        with progress_bar() as progress:
            results = evaluate(
                methods + classical_methods(),
                gather(sources, given.pool, given.clips),
                progress=progress,
                count=len(sources) + sum(min(given.clips, len(ClipPool(p))) for p in given.pool),
            )
    except (ManifestError, DatasetError, FileNotFoundError) as error:
        sys.exit(f"vergence_models.evaluate: {error}")
    except KeyboardInterrupt:
        sys.exit(130)
    tables, values = markdown(results), as_json(results)
    if given.no_evidence:
        doubts = doubts_of(networks[0])
        tables += "\n" + doubt_table(doubts)
        values["no evidence"] = {name: dataclasses.asdict(found) for name, found in doubts.items()}
    sys.stdout.write(tables)
    if given.json:
        given.json.write_text(json.dumps(values, indent=1) + "\n", "utf-8")
        given.json.with_suffix(".md").write_text(tables, "utf-8")
    if given.plots:
        draw_plots(results, given.plots)


if __name__ == "__main__":
    main()
