"""What a step of lite costs, natively and in onnxruntime, beside classical methods: one pair.

    python tests/benchmarks/model_speed.py --json FILE [--variant avx2]

A warm step of the service's models, 640x480, batch 1, one iteration, two threads, with the settings
that the service has by default; SGBM 3-way with its holes filled, at full and at half size. The
methods take turns, so that a busy moment of the machine hits all of them. Then the first frame of a
live stream and of one that wants every frame, by themselves, and PatchMatch: a warm step of one
iteration, and a first frame of three. Times are medians in milliseconds; CPU
time counts every thread of the process. `--variant` makes the native step use other instructions
than the best; onnxruntime always uses the best of this CPU (isa).
"""

import argparse
import functools
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from vergence_native import variants
from vergence_proto.geometry import Pose, RectifiedRig
from vergence_proto.instruction_set import instruction_set
from vergence_proto.sgbm import sgbm_disparity
from vergence_service.inference.model import Step, StereoView
from vergence_service.inference.native_model import NativeStereoModel
from vergence_service.inference.onnx_model import OnnxStereoModel, packaged_weights_dir
from vergence_service.inference.patchmatch_model import PatchMatchModel
from vergence_service.settings.sections import ModelSettings

HEIGHT, WIDTH = 480, 640
STARTS = 7  # rounds
RIG = RectifiedRig(WIDTH, HEIGHT, 500.0, 500.0, 319.5, 319.5, 239.5, 0.1)


def textured_pair() -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """A scene of slanted strips with texture at every scale: uint8 [H, W, 3] twice."""
    random = np.random.default_rng(0)
    texture = np.zeros((HEIGHT, WIDTH + 128, 3), np.float32)
    for scale in (2, 8, 32, 128):
        small = random.uniform(-1, 1, (HEIGHT // scale + 1, (WIDTH + 128) // scale + 1, 3))
        texture += cv2.resize(small.astype(np.float32), texture.shape[1::-1]) * 32
    texture = (texture + 128).clip(0, 255)
    column, row = np.meshgrid(
        np.arange(WIDTH, dtype=np.float32), np.arange(HEIGHT, dtype=np.float32)
    )
    disparity = 10 + row / 12 + 8 * np.floor(column / 160)
    left = cv2.remap(texture, column, row, cv2.INTER_LINEAR)
    right = cv2.remap(texture, column + disparity, row, cv2.INTER_LINEAR)
    return left.astype(np.uint8), right.astype(np.uint8)


def measure(
    methods: dict[str, Callable[[], object]], rounds: int
) -> dict[str, tuple[float, float]]:
    """Name -> median wall and CPU milliseconds; the methods take turns."""
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in methods}
    for turn in range(rounds + 3):
        for name, run in methods.items():
            cpu, wall = time.process_time(), time.perf_counter()
            run()
            spent = 1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - cpu)
            if turn >= 3:  # the first turns warm caches and thread pools up
                times[name].append(spent)
    return {
        name: (float(np.median([w for w, _ in rows])), float(np.median([c for _, c in rows])))
        for name, rows in times.items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--weights", type=Path, default=packaged_weights_dir())
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--variant", choices=variants())
    parser.add_argument("--rounds", type=int, default=40)
    given = parser.parse_args()
    left, right = textured_pair()
    settings = ModelSettings()
    onnx = OnnxStereoModel(
        given.weights,
        "lite",
        providers=["cpu"],
        threads=given.threads,
        allow_spinning=settings.allow_spinning,
    )
    native = NativeStereoModel(
        given.weights,
        "lite",
        threads=given.threads,
        allow_spinning=settings.allow_spinning,
        variant=given.variant,
    )
    view = StereoView(left, right, RIG, capture_ns=0, world_from_left=Pose.identity())
    (cold,) = native.step([Step(view, None, max(native.card.graphs))])
    warm = [Step(view, cold.state, 1)]
    found = measure(
        {
            "native": lambda: native.step(warm),
            "ort": lambda: onnx.step(warm),
            "sgbm_full": lambda: sgbm_disparity(left, right),
            "sgbm_half": lambda: sgbm_disparity(left, right, scale=0.5),
        },
        given.rounds,
    )
    starts = {
        "live_start_ms": settings.cold_iterations,
        "start_ms": settings.cold_iterations_every,
    }
    counts = {name: native.card.iterations_at_most(count) for name, count in starts.items()}
    first_frames = measure(
        {
            name: functools.partial(native.step, [Step(view, None, count)])
            for name, count in counts.items()
        },
        STARTS,
    )
    patches = PatchMatchModel(threads=given.threads)
    (first,) = patches.step([Step(view, None, 3)])
    patched = measure(
        {
            "patchmatch": lambda: patches.step([Step(view, first.state, 1)]),
            "patchmatch_start": lambda: patches.step([Step(view, None, 3)]),
        },
        STARTS,
    )
    results = {
        "native_ms": found["native"][0],
        "native_cpu_ms": found["native"][1],
        "ort_ms": found["ort"][0],
        "ort_cpu_ms": found["ort"][1],
        "sgbm_full_cpu_ms": found["sgbm_full"][1],
        "sgbm_half_cpu_ms": found["sgbm_half"][1],
        **{f"{name}_ms": step_ms for name, (step_ms, _) in patched.items()},
        "patchmatch_cpu_ms": patched["patchmatch"][1],
        "fps": 1e3 / found["native"][0],
        **{name: start_ms for name, (start_ms, _) in first_frames.items()},
    }
    row = {"isa": instruction_set(), "engine": native.engine} | {
        name: round(value, 2) for name, value in results.items()
    }
    sys.stdout.write(" ".join(f"{name} {value}" for name, value in row.items()) + "\n")
    if given.json:
        given.json.write_text(json.dumps(row) + "\n", "utf-8")


if __name__ == "__main__":
    main()
