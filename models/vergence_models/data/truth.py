"""More exact truth of the left images of shots: normals, flow and the next disparity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from vergence_models.data.raycast import Cameras, cast, to_local
from vergence_models.data.shading import view_normals
from vergence_models.data.views import Shot, both_eyes, column, in_views, padded_rows


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceTruth:
    """Truth of B shots of T frames; NaN where a pixel shows no surface."""

    normals: Tensor  # float32 [B, T, 3, H, W], unit, left camera axes, towards the camera
    flow_px: Tensor  # float32 [B, T-1, 2, H, W]: where the point is in the next frame, minus here
    next_disparity_px: Tensor  # float32 [B, T-1, H, W]: that point's disparity then


def surface_truth(
    shots: list[Shot], *, width: int, height: int, device: torch.device | str = "cpu"
) -> SurfaceTruth:
    """Follow every pixel's surface point, on still and on moving things, hidden or not."""
    count, frames = len(shots), len(shots[0].times_s)
    world_from_left = torch.from_numpy(np.stack([s.world_from_left for s in shots])).to(device)
    baseline = column([s.baseline_m for s in shots], device)
    eyes = both_eyes(world_from_left, baseline.double())
    primitives, table = in_views(padded_rows(shots, device), shots, eyes)

    def per_view(values: list[float]) -> Tensor:
        return column(values, device).repeat_interleave(frames * 2)

    focal = per_view([s.focal_px for s in shots])
    cx, cy = per_view([s.cx for s in shots]), per_view([s.cy for s in shots])
    hits = cast(primitives, Cameras(focal, focal, cx, cy, width, height))

    view, v, u = torch.meshgrid(
        *(torch.arange(n, device=device) for n in hits.primitive.shape), indexing="ij"
    )
    seen = (hits.primitive >= 0) & (view % 2 == 0)
    view, u, v, m = view[seen], u[seen], v[seen], hits.primitive[seen]
    depth = hits.depth_m[seen]
    x, y = (u - cx[view]) / focal[view], (v - cy[view]) / focal[view]
    normals = torch.full((*hits.primitive.shape, 3), torch.nan, device=device)
    normals[seen] = view_normals(table, m, x, y, depth).t()

    # The same primitive two views on is what the left eye sees of it in the next frame.
    lasts = view // 2 % frames == frames - 1
    later = torch.where(lasts, m, m + 2 * primitives.per_view)
    origin, direction = to_local(primitives.local_from_view[:, m], x, y)
    hit = torch.stack([o + depth * d for o, d in zip(origin, direction, strict=True)], -1)
    matrix = primitives.view_from_local[later]
    point = (matrix[:, :, :3] @ hit[..., None])[..., 0] + matrix[:, :, 3]
    scale = focal[view] / torch.where(point[:, 2] > 0, point[:, 2], torch.nan)
    moved = torch.stack(
        [
            point[:, 0] * scale + cx[view] - u,
            point[:, 1] * scale + cy[view] - v,
            scale * baseline[view // (2 * frames)],
        ],
        dim=-1,
    )
    motion = torch.full((*hits.primitive.shape, 3), torch.nan, device=device)
    motion[seen] = moved

    def left(values: Tensor) -> Tensor:
        return values.view(count, frames, 2, height, width, 3)[:, :, 0].permute(0, 1, 4, 2, 3)

    following = left(motion)[:, :-1]
    return SurfaceTruth(left(normals), following[:, :, :2], following[:, :, 2])
