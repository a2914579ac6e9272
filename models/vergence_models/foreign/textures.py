"""Pairs of textured planes whose disparity is known, to see what a graph makes of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Plane = NDArray[np.float32]

MARGIN_PX = 10  # blocks and convolutions blur edges


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A wall, and before it a board, seen from two cameras."""

    wall_px: int  # disparity
    board_px: int  # disparity; that of the wall if there is no board
    left: Image  # [H, W, 3]
    right: Image
    truth_px: Plane  # [H, W], of the left view; NaN where the right one does not show the point
    # Where a map of the left view has the board, and a map of the right view has the wall.
    telling: tuple[slice, slice]

    def dimmed(self) -> Scene:
        """The same scene in poor light."""
        left, right = (
            np.rint(60 + (each.astype(np.float32) - 128) / 5).astype(np.uint8)
            for each in (self.left, self.right)
        )
        return replace(self, left=left, right=right)


def texture(height: int, width: int, seed: int) -> Image:
    """Detail of 1 to 16 pixels in three colours that are alike, as in photographs."""
    random = np.random.default_rng(seed)
    total = np.zeros((height, width, 3))
    for cell in (1, 2, 4, 8, 16):
        rows, columns = -(-height // cell), -(-width // cell)
        grey = random.standard_normal((rows, columns, 1))
        colour = random.standard_normal((rows, columns, 3))
        detail = (grey + 0.3 * colour) * cell**0.5
        total += detail.repeat(cell, axis=0).repeat(cell, axis=1)[:height, :width]
    light: Image = np.clip(128 + 45 * total / total.std(), 0, 255).astype(np.uint8)
    return light


def scene(height: int, width: int, wall_px: int, board_px: int, *, seed: int) -> Scene:
    """A wall, and a board in the middle third. Both are parallel to the image."""
    wall = texture(height, width + wall_px, seed)
    left, right = wall[:, :width], wall[:, wall_px:]
    # A point at column u of the left view is at u - d of the right one.
    left, right = left.copy(), right.copy()
    truth = np.full((height, width), wall_px, np.float32)
    truth[:, :wall_px] = np.nan
    first, last = width // 3, 2 * width // 3
    rows = slice(height // 4, 3 * height // 4)
    if board_px > wall_px:
        board = texture(height, last - first, seed + 1)[rows]
        left[rows, first:last] = board
        right[rows, first - board_px : last - board_px] = board
        truth[rows, first - (board_px - wall_px) : first] = np.nan  # hidden from the right
        truth[rows, first:last] = board_px
    inner = slice(rows.start + MARGIN_PX, rows.stop - MARGIN_PX)
    telling = slice(max(first, last - board_px) + MARGIN_PX // 2, last - MARGIN_PX // 2)
    return Scene(wall_px, board_px, left, right, truth, (inner, telling))
