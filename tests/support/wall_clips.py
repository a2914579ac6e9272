"""The textured wall as clips, for tests of training."""

from __future__ import annotations

import numpy as np
import torch

from tests.support.textured_wall import BASELINE_M, FX, WallFilm
from vergence_models.data.clips import StereoClips

DISPARITY_PX, STEP_PX = 12, 6


def wall_clips(count: int, *, frames: int = 3, height: int = 64, width: int = 224) -> StereoClips:
    """Clips of walls with textures of their own."""
    random = torch.Generator().manual_seed(7)
    span = width + DISPARITY_PX + frames * STEP_PX
    planes = torch.randint(0, 256, (count, 3, height, span), generator=random, dtype=torch.uint8)
    film = WallFilm(planes.permute(0, 2, 3, 1).numpy(), width, DISPARITY_PX, STEP_PX)
    pairs = [film.pair(frame) for frame in range(frames)]
    left, right = (
        torch.from_numpy(np.stack(images, axis=1)) for images in zip(*pairs, strict=True)
    )
    poses = torch.eye(4, dtype=torch.float64).repeat(count, frames, 1, 1)
    poses[:, :, 0, 3] = torch.tensor([film.x_m(frame) for frame in range(frames)]).double()
    shape = (count, frames, height, width)
    return StereoClips(
        left=left,
        right=right,
        disparity_px=torch.full(shape, float(DISPARITY_PX)),
        visible=torch.ones(shape, dtype=torch.bool),
        world_from_left=poses,
        fx=torch.full((count,), FX),
        fy=torch.full((count,), FX),
        cx=torch.full((count,), width / 2 - 0.5),
        cy=torch.full((count,), height / 2 - 0.5),
        baseline_m=torch.full((count,), BASELINE_M),
    )
