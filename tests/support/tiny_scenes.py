"""Tiny rendered scenes and the motion of their pixels, for tests of the synthetic video."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from vergence_models.data.clips import StereoClips
from vergence_models.data.generator import GeneratorConfig
from vergence_models.data.materials import Material
from vergence_models.data.render import render
from vergence_models.data.scenes import Builder, PointLight, Scene, turn_y
from vergence_models.data.textures import TextureBank
from vergence_models.data.views import Shot

SMALL = GeneratorConfig(width=128, height=96, frames=3, texture_size=64)
FOCAL_PX, BASELINE_M = 100.0, 0.12


def still_life(build: Builder, *, poses: np.ndarray | None = None) -> Shot:
    """Film what was built from the world's origin, by one lamp behind the camera."""
    lamp = PointLight(np.array([0.3, -0.5, -1.0]), np.ones(3), 4.0)
    scene = Scene(
        primitives=np.array(build.rows, np.float32),
        lights=(lamp, lamp),
        shadow_target_m=np.array([0.0, 0.0, 2.0]),
        shadow_half_angle_rad=0.9,
        ambient=np.full(3, 0.5),
        sky_texture=0,
        sky_color=np.ones(3),
        exposure=0.4,
    )
    world_from_left = np.eye(4)[None] if poses is None else poses
    times_s = np.arange(len(world_from_left)) / 30
    return Shot(scene, world_from_left, times_s, FOCAL_PX, 63.5, 47.5, BASELINE_M)


def pixel_rays(width: int = 128, height: int = 96) -> tuple[np.ndarray, np.ndarray]:
    v, u = np.mgrid[:height, :width]
    return (u - 63.5) / FOCAL_PX, (v - 47.5) / FOCAL_PX


def film(shot: Shot, bank: TextureBank) -> np.ndarray:
    return render([shot], bank, width=128, height=96).disparity_px[0, 0].numpy()


PAINT = Material(texture=0, span_m=1.0)


def reprojected(clips: StereoClips, index: int, frame: int) -> tuple[Tensor, Tensor, Tensor]:
    """The places of a frame's pixels in the next one: u, v and disparity there, each [H, W]."""
    fx, fy, cx, cy, baseline_m = (
        float(getattr(clips, name)[index]) for name in ("fx", "fy", "cx", "cy", "baseline_m")
    )
    height, width = clips.disparity_px.shape[-2:]
    v, u = torch.meshgrid(
        torch.arange(height, dtype=torch.float64),
        torch.arange(width, dtype=torch.float64),
        indexing="ij",
    )
    z = fx * baseline_m / clips.disparity_px[index, frame].double()
    point = torch.stack([(u - cx) / fx * z, (v - cy) / fy * z, z, torch.ones_like(z)])
    world_from_left = clips.world_from_left[index]
    next_from_this = world_from_left[frame + 1].inverse() @ world_from_left[frame]
    x, y, z, _ = (next_from_this @ point.flatten(1)).view(4, height, width)
    disparity = torch.where(z > 0.05, fx * baseline_m / z, torch.nan)
    return fx * x / z + cx, fy * y / z + cy, disparity


def agreement(clips: StereoClips, index: int) -> float:
    """The share of a clip's still surfaces whose disparity the next frame confirms."""
    right = total = 0
    for frame in range(clips.frames - 1):
        u, v, expected = reprojected(clips, index, frame)
        height, width = u.shape
        inside = (u > 1) & (u < width - 2) & (v > 1) & (v < height - 2) & expected.isfinite()
        column, row = u[inside].round().long(), v[inside].round().long()
        found = clips.disparity_px[index, frame + 1]
        # Within the 3x3 pixels around the place: pixel centres of two views never coincide.
        around = torch.stack(
            [found[row + i, column + j] for i in (-1, 0, 1) for j in (-1, 0, 1)]
        ).double()
        wanted = expected[inside]
        slack_px = 0.02 + 0.005 * wanted
        fits = (around.amin(0) <= wanted + slack_px) & (around.amax(0) >= wanted - slack_px)
        right, total = right + int(fits.sum()), total + len(fits)
    return right / max(total, 1)


def furnished_shot() -> Shot:
    """A still scene with a box, a ball and a post, and a camera that moves and turns."""
    b = Builder()
    b.wall((0, 0, 4), 20, 20, PAINT)
    b.floor((0, 1.2, 0), 20, 20, PAINT)
    b.box((-0.6, 0.6, 2.2), (0.3, 0.6, 0.3), PAINT)
    b.ball((0.5, 0.2, 2.6), (0.4, 0.3, 0.4), PAINT)
    b.post((0.1, 0, 1.8), 0.1, 1.0, PAINT, taper=0.3)
    step = np.eye(4)
    step[:3, :3], step[:3, 3] = turn_y(0.03), (0.03, -0.02, 0.05)
    poses = np.stack([np.linalg.matrix_power(step, k) for k in range(4)])
    return still_life(b, poses=poses)


def furnished_room(bank: TextureBank) -> StereoClips:
    return render([furnished_shot()], bank, width=128, height=96)
