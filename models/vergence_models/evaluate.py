"""``python -m vergence_models.evaluate --json FILE``: how good an exported model is, beside SGBM.

    python -m vergence_models.evaluate --json out.json --data vergence:DIR --pool pool/val

Every method sees the same frames in the same run. Prints Markdown, writes JSON, and with
``--plots`` draws the cold-start curve.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from vergence_models.data.pool import ClipPool
from vergence_models.metrics import calibration, error_measures, temporal_error
from vergence_models.motion import perturbed
from vergence_models.sgbm import sgbm_disparity
from vergence_models.stepping import (
    Footage,
    OnnxNetwork,
    Prediction,
    footage_from_clip,
    footage_from_source,
)
from vergence_models.validation import filmed
from vergence_proto.geometry import Pose
from vergence_proto.layouts import LayoutError, find_sources, open_source
from vergence_proto.model_io import ManifestError

WEIGHTS = Path(__file__).parent / "weights"
FRAME_PIXELS = 640 * 480  # times are told for a frame of this size

Method = Callable[[Footage], Iterator[Prediction]]


def without_poses(footage: Footage) -> Footage:
    """The network is told that nothing moves."""
    return replace(footage, views=[replace(v, world_from_left=None) for v in footage.views])


def with_noisy_poses(footage: Footage) -> Footage:
    """The network is told poses that are off by up to 0.3 degrees and 1 mm."""
    import torch

    known = [view.world_from_left for view in footage.views]
    if any(pose is None for pose in known):
        return footage
    poses = torch.from_numpy(np.stack([pose.matrix for pose in known if pose is not None]))[None]
    noisy = perturbed(poses, max_deg=0.3, max_m=0.001, random=np.random.default_rng(0))[0]
    views = [
        replace(view, world_from_left=Pose.from_matrix(pose.numpy()))
        for view, pose in zip(footage.views, noisy, strict=True)
    ]
    return replace(footage, views=views)


def sgbm_method(scale: float) -> Method:
    def predict(footage: Footage) -> Iterator[Prediction]:
        limit = 192 if len(footage.views) == 1 and footage.rig.width > 700 else 128
        for view in footage.views:
            found = sgbm_disparity(view.left, view.right, max_disparity_px=limit, scale=scale)
            yield Prediction(found)

    return predict


def methods_for(network: OnnxNetwork, *, thorough: bool) -> dict[str, Method]:
    """Name -> how it predicts a sequence."""
    name, most = network.card.name, max(network.card.graphs)
    table: dict[str, Method] = {
        f"{name}, warm, 1 iteration": lambda f: network.sequence(f, cold=most, warm=1),
        f"{name}, every frame cold, {most} iterations": lambda f: network.sequence(
            f, cold=most, warm=None
        ),
    }
    if thorough:
        table[f"{name}, warm, no poses"] = lambda f: network.sequence(
            without_poses(f), cold=most, warm=1
        )
        table[f"{name}, warm, poses off by 0.3 deg and 1 mm"] = lambda f: network.sequence(
            with_noisy_poses(f), cold=most, warm=1
        )
    table["SGBM, full size"] = sgbm_method(1.0)
    table["SGBM, half size"] = sgbm_method(0.5)
    return table


@dataclass(slots=True)
class Tally:
    """The figures of one method on one kind of footage."""

    frames: list[dict[str, float]] = field(default_factory=list)
    calibrations: list[dict[str, float]] = field(default_factory=list)
    flicker: list[float] = field(default_factory=list)
    by_index: dict[int, list[float]] = field(default_factory=dict)  # frame -> EPEs
    cpu_s: float = 0.0
    wall_s: float = 0.0
    size: float = 0.0  # frames of FRAME_PIXELS

    def add(self, footage: Footage, predictions: Iterator[Prediction]) -> None:
        kept: list[Prediction] = []
        for index, view in enumerate(footage.views):
            cpu, wall = time.process_time(), time.perf_counter()
            prediction = next(predictions)
            self.cpu_s += time.process_time() - cpu
            self.wall_s += time.perf_counter() - wall
            self.size += footage.rig.width * footage.rig.height / FRAME_PIXELS
            kept = [*kept[-1:], prediction]
            if view.truth_px is None:
                continue
            measures = error_measures(prediction.disparity_px, view.truth_px)
            if measures is None:
                continue
            self.frames.append(measures)
            self.by_index.setdefault(index, []).append(measures["epe"])
            if prediction.sigma_px is not None:
                told = calibration(prediction.disparity_px, prediction.sigma_px, view.truth_px)
                self.calibrations += [told] if told else []
            before = footage.views[index - 1] if index else None
            if before is None or before.truth_px is None:
                continue
            if before.world_from_left is None or view.world_from_left is None:
                continue
            flicker = temporal_error(
                footage.rig,
                view.world_from_left.inverse() @ before.world_from_left,
                (kept[0].disparity_px, kept[1].disparity_px),
                (before.truth_px, view.truth_px),
            )
            if flicker is not None:
                self.flicker.append(flicker)

    def summary(self) -> dict[str, float]:
        """Means over frames; TEPE where poses and dense truth allow it; times per frame."""
        found = means(self.frames)
        if self.flicker:
            found["tepe"] = float(np.mean(self.flicker))
        found.update(means(self.calibrations))
        found["cpu_ms"] = 1e3 * self.cpu_s / max(self.size, 1e-9)
        found["wall_ms"] = 1e3 * self.wall_s / max(self.size, 1e-9)
        return {name: round(value, 4) for name, value in found.items()}


def means(rows: list[dict[str, float]]) -> dict[str, float]:
    return {name: float(np.mean([row[name] for row in rows])) for name in (rows[0] if rows else {})}


def gather(data: list[str], pool: list[Path], clips: int) -> Iterator[tuple[str, Footage]]:
    """(group, footage): each source on disk is a group of its own, the clips of a pool are one."""
    for spec in data:
        for source in find_sources(spec):
            footage = footage_from_source(open_source(source))
            yield footage.name, footage
    for folder in pool:
        held_out = ClipPool(folder)
        for index in range(min(clips, len(held_out))):
            batch = filmed(held_out, range(index, index + 1))
            yield f"pool {folder.name}", footage_from_clip(batch, 0, f"{folder.name}/{index}")


def evaluate(
    network: OnnxNetwork, data: list[str], pool: list[Path], *, clips: int, thorough: bool
) -> dict[str, dict[str, Tally]]:
    """Group -> method -> its figures."""
    methods = methods_for(network, thorough=thorough)
    results: dict[str, dict[str, Tally]] = {}
    for group, footage in gather(data, pool, clips):
        tallies = results.setdefault(group, {name: Tally() for name in methods})
        for name, method in methods.items():
            tallies[name].add(footage, method(footage))
    return results


COLUMNS = ("epe", "d1", "bad2", "d3", "d5", "p95", "p97", "p99", "tepe", "within_50", "cpu_ms")


def markdown(results: dict[str, dict[str, Tally]]) -> str:
    """One table per group."""
    parts = []
    for group, tallies in results.items():
        lines = [f"### {group}", "", "| method | " + " | ".join(COLUMNS) + " |"]
        lines.append("|---|" + "---:|" * len(COLUMNS))
        for name, tally in tallies.items():
            summary = tally.summary()
            cells = [f"{summary[key]:.3g}" if key in summary else "" for key in COLUMNS]
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
        parts.append("\n".join(lines))
    return "\n\n".join(parts)


def as_json(results: dict[str, dict[str, Tally]]) -> dict[str, object]:
    return {
        group: {
            name: {
                **tally.summary(),
                "epe_by_frame": [round(float(np.mean(e)), 4) for e in tally.by_index.values()],
            }
            for name, tally in tallies.items()
        }
        for group, tallies in results.items()
    }


def draw_plots(results: dict[str, dict[str, Tally]], folder: Path) -> None:
    """EPE against the frame's number, one PNG per group of sequences."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    for group, tallies in results.items():
        if max((len(tally.by_index) for tally in tallies.values()), default=0) < 2:
            continue
        figure, axes = plt.subplots(figsize=(8, 4))
        for name, tally in tallies.items():
            axes.plot([index + 1 for index in tally.by_index], means_by_index(tally), label=name)
        axes.set(xlabel="frame", ylabel="EPE [px]", title=group, ylim=(0, None))
        axes.legend(fontsize="small")
        figure.tight_layout()
        figure.savefig(folder / f"{group.replace(' ', '_')}.png", dpi=110)
        plt.close(figure)


def means_by_index(tally: Tally) -> list[float]:
    return [float(np.mean(errors)) for errors in tally.by_index.values()]


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="vergence_models.evaluate", description=__doc__)
    parser.add_argument("--weights", type=Path, default=WEIGHTS, help="folder with a manifest")
    parser.add_argument("--model", default="lite")
    parser.add_argument("--data", nargs="*", default=[], help="KIND:PATH, as vergence run takes it")
    parser.add_argument("--pool", type=Path, nargs="*", default=[], help="held-out clips")
    parser.add_argument("--clips", type=int, default=32, help="of each pool")
    parser.add_argument("--thorough", action="store_true", help="also without and with noisy poses")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--plots", type=Path, help="folder for PNGs")
    given = parser.parse_args(arguments)
    if not (given.data or given.pool):
        parser.error("nothing to evaluate on: name --data KIND:PATH or --pool DIR")
    try:
        network = OnnxNetwork(given.weights, given.model, threads=given.threads)
        results = evaluate(
            network, given.data, given.pool, clips=given.clips, thorough=given.thorough
        )
    except (ManifestError, LayoutError, FileNotFoundError) as error:
        sys.exit(f"vergence_models.evaluate: {error}")
    sys.stdout.write(markdown(results) + "\n")
    if given.json:
        given.json.write_text(json.dumps(as_json(results), indent=1) + "\n", "utf-8")
    if given.plots:
        draw_plots(results, given.plots)


if __name__ == "__main__":
    main()
