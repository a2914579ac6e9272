"""A textured wall, filmed by a rig that steps aside along it: its truth is known by construction.

The wall is square to the camera, so every pixel has the same disparity.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

WIDTH, HEIGHT = 256, 96
DISPARITY_PX = 6
FX = 200.0
BASELINE_M = 0.1

Texture = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class WallFilm:
    """What the rig sees of ``texture``, uint8 [..., H, W, 3], of which an image shows a part."""

    texture: Texture
    width: int
    disparity_px: int
    step_px: int
    """By which the image shifts from one frame to the next."""

    def pair(self, frame: int) -> tuple[Texture, Texture]:
        """The left and the right image, uint8 [..., H, width, 3]."""
        start = frame * self.step_px
        left, right = (
            self.texture[..., at : at + self.width, :] for at in (start, start + self.disparity_px)
        )
        return left, right

    def x_m(self, frame: int) -> float:
        """How far the rig has moved to the right."""
        return frame * self.step_px * BASELINE_M / self.disparity_px


def write_wall(directory: Path, *, frames: int, fps: float = 30.0) -> Path:
    """Write a ``vergence:`` sequence of the wall."""
    directory.mkdir(parents=True)
    noise = np.random.default_rng(7).integers(0, 256, (HEIGHT, 2 * WIDTH, 3), np.uint8)
    wall = np.asarray(cv2.GaussianBlur(noise, (5, 5), 1.2), np.uint8)
    film = WallFilm(wall, WIDTH, DISPARITY_PX, step_px=2)
    calib = {
        **{"fx": FX, "fy": FX, "cx": (WIDTH - 1) / 2, "cy": (HEIGHT - 1) / 2},
        **{"baseline_m": BASELINE_M, "width": WIDTH, "height": HEIGHT, "fps": fps},
    }
    (directory / "calib.json").write_text(json.dumps(calib))
    poses = []
    for index in range(frames):
        stem = f"frame_{index:04d}"
        left, right = film.pair(index)
        cv2.imwrite(str(directory / f"{stem}_left.png"), left)
        cv2.imwrite(str(directory / f"{stem}_right.png"), right)
        truth = np.full((HEIGHT, WIDTH), 64 * DISPARITY_PX, np.uint16)
        np.savez(directory / f"{stem}_gt.npz", disp=truth)
        poses.append([1, 0, 0, film.x_m(index), 0, 1, 0, 0, 0, 0, 1, 0])
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
