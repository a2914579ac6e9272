"""Shots, and their primitives in the axes of every view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vergence_models.data import scenes
from vergence_models.data.raycast import Primitives
from vergence_models.data.scenes import Scene
from vergence_models.data.shapes import Shape
from vergence_models.data.trajectories import rotation


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """A scene and the rectified stereo camera that films it for T frames."""

    scene: Scene
    world_from_left: NDArray[np.float64]  # [T, 4, 4]
    times_s: NDArray[np.float64]  # [T]
    focal_px: float
    cx: float
    cy: float
    baseline_m: float


def column(values: list[float], device: torch.device | str) -> Tensor:
    return torch.tensor(values, dtype=torch.float32, device=device)


def both_eyes(world_from_left: Tensor, baseline_m: Tensor) -> Tensor:
    """Poses [B, T, 2, 4, 4] of left and right eyes, from those of the left [B, T, 4, 4]."""
    left_from_right = torch.eye(4, dtype=torch.float64, device=baseline_m.device)
    left_from_right = left_from_right.repeat(len(baseline_m), 1, 1, 1)
    left_from_right[:, 0, 0, 3] = baseline_m
    return torch.stack([world_from_left, world_from_left @ left_from_right], dim=2)


def padded_rows(shots: list[Shot], device: torch.device | str) -> Tensor:
    """All scenes as float64 [B, P, COLUMNS], filled up with primitives that nothing hits."""
    longest = max(len(s.scene.primitives) for s in shots)
    padded = np.zeros((len(shots), longest, scenes.COLUMNS))
    padded[:, :, scenes.SHAPE] = Shape.PAD
    padded[:, :, scenes.HALF_M] = 1
    padded[:, :, scenes.ROTATION] = np.eye(3).ravel()
    padded[:, :, scenes.MATERIAL.start + 1] = 1  # span_m is divided by
    for row, shot in zip(padded, shots, strict=True):
        row[: len(shot.scene.primitives)] = shot.scene.primitives
    return torch.from_numpy(padded).to(device)


def in_views(rows: Tensor, shots: list[Shot], world_from_view: Tensor) -> tuple[Primitives, Tensor]:
    """The primitives in the axes of every view, and the table that shading reads, [C, M]."""
    count, per_view = rows.shape[:2]
    frames = world_from_view.shape[1]
    times = torch.from_numpy(np.stack([s.times_s for s in shots])).to(rows.device)
    center = rows[:, None, :, scenes.CENTER_M] + (
        times[:, :, None, None] * rows[:, None, :, scenes.VELOCITY_M_S]
    )
    turned = rotation((times[:, :, None, None] * rows[:, None, :, scenes.SPIN_RAD_S]).cpu().numpy())
    start = rows[:, None, :, scenes.ROTATION].reshape(count, 1, per_view, 3, 3)
    world_from_local = torch.from_numpy(turned).to(rows.device) @ start  # [B, T, P, 3, 3]

    view_from_world = world_from_view.inverse()[:, :, :, None]
    turn = view_from_world[..., :3, :3] @ world_from_local[:, :, None]
    shift = view_from_world[..., :3, :3] @ center[:, :, None, :, :, None]
    shift = shift + view_from_world[..., :3, 3:]
    half = rows[:, None, None, :, scenes.HALF_M].expand(-1, frames, 2, -1, -1)

    def flat(values: Tensor) -> Tensor:
        spread = values[:, None, None].expand(-1, frames, 2, *values.shape[1:])
        return spread.reshape(-1, *values.shape[2:]).float()

    inverse = turn.transpose(-1, -2) / half[..., None]
    local_from_view = torch.cat([inverse, -inverse @ shift], -1).reshape(-1, 12).t().float()
    primitives = Primitives(
        shape=flat(rows[:, :, scenes.SHAPE]).long(),
        local_from_view=local_from_view.contiguous(),
        view_from_local=torch.cat([turn * half[..., None, :], shift], -1).view(-1, 3, 4).float(),
        taper=flat(rows[:, :, scenes.TAPER]),
        cutout=flat(rows[:, :, scenes.CUTOUT]),
        views=count * frames * 2,
    )
    listed = [scenes.HALF_M, slice(scenes.SHAPE, scenes.SHAPE + 1), scenes.MATERIAL]
    about = torch.cat([flat(rows[:, :, part]) for part in listed], dim=-1).t()
    return primitives, torch.cat([local_from_view, about]).contiguous()
