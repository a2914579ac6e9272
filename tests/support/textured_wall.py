"""A sequence on disk whose truth is known by construction: a textured wall, filmed on the move."""

import json
from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT = 256, 96
DISPARITY_PX = 6
FX = 200.0
BASELINE_M = 0.1
STEP_PX = 2  # by which the picture shifts from one frame to the next


def write_wall(directory: Path, *, frames: int, fps: float = 30.0) -> Path:
    """Write a ``vergence:`` sequence: the camera moves right along a wall that it faces."""
    directory.mkdir(parents=True)
    noise = np.random.default_rng(7).integers(0, 256, (HEIGHT, 2 * WIDTH, 3), np.uint8)
    wall = cv2.GaussianBlur(noise, (5, 5), 1.2)
    metres_per_px = FX * BASELINE_M / DISPARITY_PX / FX
    calib = {
        **{"fx": FX, "fy": FX, "cx": (WIDTH - 1) / 2, "cy": (HEIGHT - 1) / 2},
        **{"baseline_m": BASELINE_M, "width": WIDTH, "height": HEIGHT, "fps": fps},
    }
    (directory / "calib.json").write_text(json.dumps(calib))
    poses = []
    for index in range(frames):
        stem = f"frame_{index:04d}"
        start = index * STEP_PX
        left, right = (wall[:, at : at + WIDTH] for at in (start, start + DISPARITY_PX))
        cv2.imwrite(str(directory / f"{stem}_left.png"), left)
        cv2.imwrite(str(directory / f"{stem}_right.png"), right)
        truth = np.full((HEIGHT, WIDTH), 64 * DISPARITY_PX, np.uint16)
        np.savez(directory / f"{stem}_gt.npz", disp=truth)
        poses.append([1, 0, 0, start * metres_per_px, 0, 1, 0, 0, 0, 0, 1, 0])
    np.savetxt(directory / "poses.txt", poses)
    return directory


def write_pair(directory: Path) -> Path:
    """Write a ``vergence:`` pair: the first frame of the same wall."""
    sequence = write_wall(directory.with_name(f"{directory.name}-film"), frames=1)
    directory.mkdir()
    for side in ("left", "right"):
        (sequence / f"frame_0000_{side}.png").rename(directory / f"{side}.png")
    (sequence / "calib.json").rename(directory / "calib.json")
    return directory
