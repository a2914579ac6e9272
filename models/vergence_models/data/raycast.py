"""Tiled ray casting, batched over views: the visible primitive of each pixel, and its depth.

Primitives are binned into square tiles of the image by the bounds of their boxes, so a ray meets
only the few primitives near it. Depth is that of the exact ray through the pixel centre.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from vergence_models.data.shapes import NEAR_M, Shape, Vector, intersect

TILE_PX = 16
_LANES = TILE_PX * TILE_PX
_CHUNK_TILES = 128  # 32 Ki rays a chunk: its temporaries stay in a core's cache


class Primitives(NamedTuple):
    """The primitives of V views, P each, flattened to M = V * P. Index m belongs to view m // P."""

    shape: Tensor  # int64 [M], values of `Shape`
    local_from_view: Tensor  # float32 [12, M]: the rows of a 3x4 matrix into the canonical frame
    view_from_local: Tensor  # float32 [M, 3, 4], the same the other way
    taper: Tensor  # float32 [M]
    cutout: Tensor  # float32 [M], values of `Cutout`
    views: int

    @property
    def per_view(self) -> int:
        return self.shape.shape[0] // self.views


class Cameras(NamedTuple):
    """Pinhole cameras of V views that share one image size. Tensors are float32 [V], pixels."""

    fx: Tensor
    fy: Tensor
    cx: Tensor
    cy: Tensor
    width: int
    height: int


@dataclass(frozen=True, slots=True, eq=False)
class RayHits:
    """The first hits of the rays through the pixel centres of V views."""

    depth_m: Tensor  # float32 [V, H, W] along the optical axis; infinite where nothing is hit
    primitive: Tensor  # int64 [V, H, W], index m into `Primitives`; -1 where nothing is hit


def cast(primitives: Primitives, cameras: Cameras) -> RayHits:
    """The nearest hit at every pixel centre of every view."""
    rows, columns = -(-cameras.height // TILE_PX), -(-cameras.width // TILE_PX)
    device = primitives.shape.device
    first_row, last_row, first_column, last_column = _tile_bounds(primitives, cameras)
    tile_y = torch.arange(rows, device=device)
    tile_x = torch.arange(columns, device=device)
    overlap = ((tile_y >= first_row[:, None]) & (tile_y <= last_row[:, None]))[:, :, None] & (
        (tile_x >= first_column[:, None]) & (tile_x <= last_column[:, None])
    )[:, None, :]

    tiles = primitives.views * rows * columns
    depth = torch.full((tiles, _LANES), float("inf"), device=device)
    owner = torch.full((tiles, _LANES), -1, dtype=torch.int32, device=device)
    lane = torch.arange(_LANES, device=device)
    lane_x, lane_y = (lane % TILE_PX).float(), (lane // TILE_PX).float()

    for shape in (Shape.BOX, Shape.ELLIPSOID, Shape.CYLINDER, Shape.QUAD):
        m, y, x = (overlap & (primitives.shape == shape)[:, None, None]).nonzero(as_tuple=True)
        if not len(m):
            continue
        view = m // primitives.per_view
        tile = (view * rows + y) * columns + x
        for pick in _rounds(tile):
            for part in torch.split(pick, _CHUNK_TILES):
                part_m, part_view, part_tile = m[part], view[part], tile[part]
                u = (x[part] * TILE_PX)[:, None] + lane_x
                v = (y[part] * TILE_PX)[:, None] + lane_y
                ray_x = (u - cameras.cx[part_view, None]) / cameras.fx[part_view, None]
                ray_y = (v - cameras.cy[part_view, None]) / cameras.fy[part_view, None]
                t = intersect_rays(primitives, shape, part_m, ray_x, ray_y)
                nearest = depth.index_select(0, part_tile)
                wins = t < nearest
                depth[part_tile] = torch.minimum(t, nearest)
                owner[part_tile] = torch.where(
                    wins, part_m[:, None].int(), owner.index_select(0, part_tile)
                )

    size = (primitives.views, cameras.height, cameras.width)
    return RayHits(_untile(depth, rows, columns, size), _untile(owner, rows, columns, size).long())


def intersect_rays(
    primitives: Primitives, shape: Shape, m: Tensor, ray_x: Tensor, ray_y: Tensor
) -> Tensor:
    """Depth [P, S] where rays (x, y, 1) [P, S] meet primitives m [P], all of one shape."""
    rows = primitives.local_from_view.index_select(1, m)[..., None]
    origin, direction = to_local(rows, ray_x, ray_y)
    return intersect(
        shape,
        origin,
        direction,
        taper=primitives.taper[m, None],
        cutout=primitives.cutout[m, None],
    )


def to_local(rows: Tensor, ray_x: Tensor, ray_y: Tensor) -> tuple[Vector, Vector]:
    """Origin and direction of camera rays (x, y, 1) under the 3x4 transforms `rows` [12, ...]."""
    origin = (rows[3], rows[7], rows[11])
    direction = (
        rows[0] * ray_x + (rows[1] * ray_y + rows[2]),
        rows[4] * ray_x + (rows[5] * ray_y + rows[6]),
        rows[8] * ray_x + (rows[9] * ray_y + rows[10]),
    )
    return origin, direction


def _rounds(tile: Tensor) -> list[Tensor]:
    """Split pairs into rounds that name each tile at most once, so that writes never collide."""
    order = tile.argsort(stable=True)
    ordered = tile[order]
    position = torch.arange(len(tile), device=tile.device)
    starts = torch.ones_like(ordered, dtype=torch.bool)
    starts[1:] = ordered[1:] != ordered[:-1]
    rank = position - torch.cummax(torch.where(starts, position, 0), dim=0).values
    by_rank = rank.argsort(stable=True)
    return list(torch.split(order[by_rank], torch.bincount(rank).tolist()))


def _untile(tiled: Tensor, rows: int, columns: int, size: tuple[int, int, int]) -> Tensor:
    views, height, width = size
    image = tiled.view(views, rows, columns, TILE_PX, TILE_PX).transpose(2, 3)
    return image.reshape(views, rows * TILE_PX, columns * TILE_PX)[:, :height, :width].contiguous()


def _tile_bounds(primitives: Primitives, cameras: Cameras) -> tuple[Tensor, ...]:
    """First and last tile row and column [M] that the box of each primitive can touch."""
    corners = torch.cartesian_prod(*(torch.tensor([-1.0, 1.0]),) * 3).to(primitives.taper.device)
    flat = torch.where(primitives.shape == Shape.QUAD, 0.0, 1.0)
    swell = 1 + primitives.taper.abs()
    local = corners * torch.stack([swell, swell, flat], -1)[:, None]  # [M, 8, 3]
    matrix = primitives.view_from_local
    view = torch.einsum("mij,mkj->mki", matrix[:, :, :3], local) + matrix[:, None, :, 3]
    # Edges that pierce the near plane contribute their piercing points.
    a, b = view[:, _EDGES[0]], view[:, _EDGES[1]]
    share = (NEAR_M - a[..., 2]) / (b[..., 2] - a[..., 2])
    pierces = (a[..., 2] < NEAR_M) != (b[..., 2] < NEAR_M)
    points = torch.cat([view, a + share.nan_to_num()[..., None] * (b - a)], dim=1)
    seen = torch.cat([view[..., 2] >= NEAR_M, pierces], dim=1)
    seen &= (primitives.shape != Shape.PAD)[:, None]

    camera = torch.arange(len(flat), device=flat.device) // primitives.per_view
    z = points[..., 2].clamp(min=NEAR_M)
    u = points[..., 0] / z * cameras.fx[camera, None] + cameras.cx[camera, None]
    v = points[..., 1] / z * cameras.fy[camera, None] + cameras.cy[camera, None]

    def tiles(pixels: Tensor) -> tuple[Tensor, Tensor]:
        margin = 1.0  # float32 slack; half a pixel would be exact
        first = torch.where(seen, pixels, 1e6).amin(1) - margin
        last = torch.where(seen, pixels, -1e6).amax(1) + margin
        return (first / TILE_PX).floor(), (last / TILE_PX).floor()

    first_column, last_column = tiles(u)
    first_row, last_row = tiles(v)
    return first_row, last_row, first_column, last_column


# Pairs of corners that differ in one coordinate, in the order of `cartesian_prod`.
_EDGES = (
    [0, 0, 0, 1, 1, 2, 2, 3, 4, 4, 5, 6],
    [1, 2, 4, 3, 5, 3, 6, 7, 5, 6, 7, 7],
)
