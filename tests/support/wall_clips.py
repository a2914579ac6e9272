"""Tiny clips for tests of training: a textured wall that a moving rig looks at."""

from __future__ import annotations

import torch

from vergence_models.data.clips import StereoClips


def wall_clips(count: int, *, frames: int = 3, height: int = 64, width: int = 224) -> StereoClips:
    """Clips of a wall square to the camera at 12 px of disparity, the rig stepping aside."""
    random = torch.Generator().manual_seed(7)
    disparity, step_px = 12, 6
    span = width + disparity + frames * step_px
    planes = torch.randint(0, 256, (count, 3, height, span), generator=random, dtype=torch.uint8)
    texture = planes.permute(0, 2, 3, 1)
    starts = [k * step_px for k in range(frames)]
    left = torch.stack([texture[:, :, s : s + width] for s in starts], dim=1)
    right = torch.stack([texture[:, :, s + disparity :][:, :, :width] for s in starts], dim=1)
    poses = torch.eye(4, dtype=torch.float64).repeat(count, frames, 1, 1)
    baseline_m = 0.1
    poses[:, :, 0, 3] = torch.tensor(starts).double() * baseline_m / disparity
    shape = (count, frames, height, width)
    return StereoClips(
        left=left,
        right=right,
        disparity_px=torch.full(shape, float(disparity)),
        visible=torch.ones(shape, dtype=torch.bool),
        world_from_left=poses,
        fx=torch.full((count,), 200.0),
        fy=torch.full((count,), 200.0),
        cx=torch.full((count,), width / 2 - 0.5),
        cy=torch.full((count,), height / 2 - 0.5),
        baseline_m=torch.full((count,), baseline_m),
    )
