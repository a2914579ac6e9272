"""Measure how long ``depth_at`` takes on one core, and what it costs in error.

    python tests/benchmarks/depth_at.py --json FILE

The shipped network's maps of the bundled sequence, 640x480, are shown 0.1 s later, with a keyframe
0.3 s old. ``step_2`` are maps of which every second pixel was sent, the default off the machine;
``step_1`` are whole maps. Per kind:

- ``cpu_ms``: the processor's time of one call, of all threads: the least and the median.
- ``baseline_cpu_ms``: the same of a forward splat in plain numpy, at full size and without holes
  filled (a sort by depth, and four writes for each pixel).
- ``epe_ratio_covered epe_ratio_all covered``: as in ``bad_link.py``; ``as_is``: the ratio if the
  map is not moved.
"""

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

REPOSITORY = Path(__file__).parents[2]
sys.path.insert(0, str(REPOSITORY))  # tests.support

from tests.support.headset import Sequence  # noqa: E402
from tests.support.recorded_model import record  # noqa: E402
from vergence import DepthResult, Pose, RectifiedRig, reproject  # noqa: E402
from vergence_proto.codec.steps import widen_plane  # noqa: E402
from vergence_proto.datasets import open_source  # noqa: E402
from vergence_proto.geometry import uvd_curr_from_prev  # noqa: E402
from vergence_proto.instruction_set import instruction_set  # noqa: E402
from vergence_proto.types import ReceivedPlanes  # noqa: E402

SEQUENCE = REPOSITORY / "client/vergence/sample/room"
LATER, KEYFRAME = 3, 9  # frames of 1 / 30 s
REPEATS = 60


def received(maps: NDArray[np.float32], index: int, step: int, sequence: Sequence) -> DepthResult:
    """Return a map as the SDK has it after its way."""
    rig, denominator = sequence.rig, 64 if step == 1 else 16
    sent_px = (np.round(maps[index, ::step, ::step] * denominator) / denominator).astype(np.float32)
    return DepthResult(
        frame_id=index,
        capture_ns=index * 33_333_333,
        rig=rig,
        disparity_px=widen_plane(sent_px, step, (rig.width, rig.height)),
        world_from_left=sequence.poses[index],
        raw=ReceivedPlanes(step, sent_px),
    )


def plain_splat(result: DepthResult, world_from_view: Pose, rig: RectifiedRig) -> NDArray[Any]:
    """Move a map as one writes it at first."""
    assert result.world_from_left is not None
    matrix = uvd_curr_from_prev(rig, world_from_view.inverse() @ result.world_from_left)
    v, u = np.mgrid[: rig.height, : rig.width].astype(np.float32)
    known = result.disparity_px > 0
    uvd1 = np.stack([u[known], v[known], result.disparity_px[known], np.ones(known.sum(), "f4")])
    x, y, disparity_px, w = matrix @ uvd1
    x, y, disparity_px = np.floor(x / w), np.floor(y / w), disparity_px / w
    order = np.argsort(disparity_px)
    shown = np.zeros((rig.height + 1, rig.width + 1), np.float32)
    for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
        to_x, to_y = x[order] + right, y[order] + down
        inside = (to_x >= 0) & (to_y >= 0) & (to_x < rig.width) & (to_y < rig.height)
        at = to_y[inside].astype(np.int32), to_x[inside].astype(np.int32)
        shown[at] = disparity_px[order][inside]
    return shown[:-1, :-1]


def cpu_ms(call: Callable[[], object], repeats: int = REPEATS) -> list[float]:
    """Return the least and the median of the processor's time, of all threads."""
    took_s = []
    for _ in range(repeats):
        began_s = time.process_time()
        call()
        took_s.append(time.process_time() - began_s)
    return [round(float(each) * 1e3, 1) for each in (min(took_s), np.median(took_s))]


def measure(maps: NDArray[np.float32], step: int, sequence: Sequence) -> dict[str, Any]:
    rig, rows = sequence.rig, []
    for index in range(KEYFRAME, len(maps) - LATER, 3):
        at, truth_px = index + LATER, sequence.truths_px[index + LATER]
        seen = reproject(
            received(maps, index, step, sequence),
            sequence.poses[at],
            keyframes=[received(maps, index - KEYFRAME, step, sequence)],
        )
        known = np.isfinite(truth_px) & np.isfinite(seen.depth_m)
        covered = known & seen.covered
        shown_px = rig.fx * rig.baseline_m / seen.depth_m
        moved, fresh, still = (
            np.abs(each - truth_px) for each in (shown_px, maps[at], maps[index])
        )
        rows.append(
            [moved[covered].mean(), fresh[covered].mean()]
            + [each[known].mean() for each in (moved, fresh, still)]
            + [seen.covered.mean()]
        )
    moved, fresh, all_moved, all_fresh, all_still, share = np.nanmean(rows, axis=0)
    newest, keyframe = (received(maps, index, step, sequence) for index in (KEYFRAME, 0))
    pose = sequence.poses[KEYFRAME + LATER]
    return {
        "cpu_ms": cpu_ms(lambda: reproject(newest, pose, keyframes=[keyframe])),
        "baseline_cpu_ms": cpu_ms(lambda: plain_splat(newest, pose, rig), REPEATS // 4),
        "epe_ratio_covered": round(float(moved / fresh), 3),
        "epe_ratio_all": round(float(all_moved / all_fresh), 3),
        "as_is": round(float(all_still / all_fresh), 3),
        "covered": round(float(share), 3),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, required=True)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    sequence = Sequence.load(str(SEQUENCE))
    source = open_source(f"vergence:{SEQUENCE}")
    with tempfile.TemporaryDirectory() as folder:
        maps = record([each.frame for each in source], source.rig, Path(folder, "maps.npz"))
    figures: dict[str, Any] = {"instruction_set": instruction_set()}
    for step in (2, 1):
        figures[f"step_{step}"] = measure(maps, step, sequence)
        print(f"step_{step}", json.dumps(figures[f"step_{step}"]), flush=True)  # noqa: T201
    args.json.write_text(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
