"""Warping of the state of the previous frame to the view of the current one.

All points are (u, v, d, 1): pixels and disparity of the left image, at full resolution, with pixel
centres at integers. A 4x4 matrix takes points of the previous frame to the current frame.
"""

from __future__ import annotations

import functools
import itertools

import torch
import torch.nn.functional as F
from torch import Tensor

MIN_DISPARITY_PX = 0.05  # a stereo camera cannot place surfaces of smaller disparity
SPLAT_SHARPNESS = 1.0  # 1/px: a surface nearer by 3 px has 20 times the weight


def cell_centres(height: int, width: int, scale: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Full-resolution u [1, W] and v [H, 1] of the centres of cells of ``scale`` pixels."""
    offset = (scale - 1) / 2
    u = torch.arange(width, device=like.device).to(like.dtype)[None, :] * scale + offset
    v = torch.arange(height, device=like.device).to(like.dtype)[:, None] * scale + offset
    return u, v


def transform_uvd(matrix: Tensor, u: Tensor, v: Tensor, d: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Apply ``matrix`` [B, 4, 4] to (u, v, d, 1), each [B, H, W]; points behind give d = 0."""
    points = torch.stack((u.expand_as(d), v.expand_as(d), d, torch.ones_like(d)), dim=1)
    moved = torch.matmul(matrix, points.flatten(2)).view(points.shape)
    x, y, z, w = (moved[:, row] for row in range(4))
    in_front = (w > 1e-3).to(d.dtype)
    scale = in_front / w.clamp(min=1e-3)
    return x * scale, y * scale, z * scale


def inverse_4x4(matrix: Tensor) -> Tensor:
    """Inverse of [B, 4, 4] by Cayley-Hamilton: matrix products alone, which every runtime has."""
    eye = torch.eye(4, dtype=matrix.dtype, device=matrix.device)

    def trace(m: Tensor) -> Tensor:
        return (m * eye).sum(dim=(1, 2), keepdim=True)

    # Faddeev-LeVerrier: m1 = A - t1 I, m2 = A m1 - t2 I, ...; then A m3 = -c0 I.
    m1 = matrix - trace(matrix) * eye
    a1 = torch.matmul(matrix, m1)
    m2 = a1 - trace(a1) / 2 * eye
    a2 = torch.matmul(matrix, m2)
    m3 = a2 - trace(a2) / 3 * eye
    return m3 / (trace(torch.matmul(matrix, m3)) / 4)


def splat_nearest(d: Tensor, column: Tensor, row: Tensor) -> Tensor:
    """Scatter ``d`` [B, H, W] to integer cells; the nearest surface wins, 0 where nothing lands."""
    batch, height, width = d.shape
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (d > MIN_DISPARITY_PX)
    index = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
    value = torch.where(inside, d, torch.zeros_like(d))
    canvas = torch.zeros_like(value).flatten(1)
    landed = canvas.scatter_reduce(1, index.flatten(1).long(), value.flatten(1), "amax")
    return landed.view(batch, height, width)


def fill_cracks(d: Tensor) -> Tensor:
    """Close the one-cell cracks that forward splatting leaves, [B, H, W].

    An empty cell takes the mean of its neighbours when most of them are filled.
    """
    filled = (d > 0).to(d.dtype)
    both = F.avg_pool2d(torch.stack((d, filled), dim=1), 3, stride=1, padding=1)
    mean = both[:, 0] / both[:, 1].clamp(min=1e-6)
    return torch.where((filled < 0.5) & (both[:, 1] > 0.5), mean, d)


def sample_bilinear(plane: Tensor, column: Tensor, row: Tensor) -> Tensor:
    """Bilinear samples of ``plane`` [B, H, W] at float cells [B, H', W'], clamped.

    Four gathers instead of grid_sample, which is thirty times slower under onnxruntime.
    """
    height, width = plane.shape[1:]
    x = column.clamp(0, width - 1)
    y = row.clamp(0, height - 1)
    x0, y0 = torch.floor(x), torch.floor(y)
    terms = []
    for dy, dx in itertools.product((0, 1), repeat=2):
        share = (1 - (x - x0 - dx).abs()) * (1 - (y - y0 - dy).abs())
        cell = (y0 + dy).clamp(max=height - 1) * width + (x0 + dx).clamp(max=width - 1)
        picked = plane.flatten(1).gather(1, cell.flatten(1).long())
        terms.append(picked.view(column.shape) * share)
    return functools.reduce(torch.add, terms)


def sample_nearest(features: Tensor, column: Tensor, row: Tensor) -> Tensor:
    """Samples of ``features`` [B, C, H, W] nearest to float cells [B, H', W'], clamped.

    The channels of a cell lie side by side, so that each cell is one copy.
    """
    batch, channels, height, width = features.shape
    x = torch.floor(column + 0.5).clamp(0, width - 1)
    y = torch.floor(row + 0.5).clamp(0, height - 1)
    first = torch.arange(batch, device=features.device)[:, None, None] * (height * width)
    index = (y * width + x).long() + first
    picked = features.permute(0, 2, 3, 1).reshape(-1, channels).index_select(0, index.flatten())
    return picked.view(*index.shape, channels).permute(0, 3, 1, 2)


def splat_softmax(values: Tensor, column: Tensor, row: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
    """Forward-warp ``values`` [B, C, H, W] to float cells ``column``, ``row`` [B, H, W].

    Each value is shared bilinearly among the four cells round where it lands. Where several
    meet, they are averaged with weights that grow exponentially with their disparity ``d`` px
    [B, H, W]: the nearest surface wins (softmax splatting, Niklaus and Liu, CVPR 2020). Values
    without a disparity land nowhere. Returns the warped values, 0 where nothing lands, and where
    something does, [B, 1, H, W].
    """
    batch, channels, height, width = values.shape
    left, top = torch.floor(column), torch.floor(row)
    cells, parts = [], []
    for dy, dx in itertools.product((0, 1), repeat=2):
        x, y = left + dx, top + dy
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height) & (d > MIN_DISPARITY_PX)
        part = (1 - (column - x).abs()) * (1 - (row - y).abs())
        cells.append((y.clamp(0, height - 1) * width + x.clamp(0, width - 1)).flatten(1))
        parts.append((part * inside.to(d.dtype)).flatten(1))
    cell, part = torch.cat(cells, dim=1).long(), torch.cat(parts, dim=1)
    d = d.flatten(1).repeat(1, 4)
    # As in any softmax the largest is subtracted, here of those that land mostly in this cell.
    mostly = torch.where(part >= 0.25, d, torch.zeros_like(d))
    nothing = torch.zeros_like(mostly[:, : height * width])
    nearest = nothing.scatter_reduce(1, cell, mostly, "amax")
    weight = part * torch.exp((d - nearest.gather(1, cell)).clamp(max=0) * SPLAT_SHARPNESS)
    # One scatter of rows: a cell's channels lie side by side.
    rows = torch.cat((values.flatten(2), torch.ones_like(values[:, :1]).flatten(2)), dim=1)
    rows = rows.transpose(1, 2).repeat(1, 4, 1) * weight[:, :, None]
    first = torch.arange(batch, device=d.device)[:, None] * (height * width)
    canvas = torch.zeros_like(rows[:, : height * width]).reshape(-1, channels + 1)
    index = ((cell + first).flatten(),)
    landed = canvas.index_put(index, rows.reshape(-1, channels + 1), accumulate=True)
    landed = landed.view(batch, height * width, channels + 1).transpose(1, 2)
    mass = landed[:, channels:]
    seen = (mass > 0.2).to(values.dtype)
    warped = landed[:, :channels] / mass.clamp(min=0.2) * seen
    return warped.reshape(values.shape), seen.reshape(batch, 1, height, width)


def splat_levels(
    disparity: Tensor, levels: tuple[Tensor, ...], uvd_curr_from_prev: Tensor, *, scale: int
) -> list[tuple[Tensor, Tensor]]:
    """Take disparity and features of ever coarser cells to the current view by softmax splatting.

    ``disparity`` [B, 1, H/s, W/s] px at full resolution, 0 = nothing; ``levels`` [B, C, h, w] of
    cells of s, 2 s, 4 s, ... pixels. Returns each with its mask, as :func:`splat_softmax`: the
    moved disparity first. Geometry passes no gradient, values do.
    """
    warped = []
    for level, values in enumerate((disparity, *levels)):
        step = 2 ** max(level - 1, 0)
        cell = scale * step
        d = F.max_pool2d(disparity.detach(), step)[:, 0]
        u, v = cell_centres(d.shape[1], d.shape[2], cell, d)
        u_to, v_to, d_to = transform_uvd(uvd_curr_from_prev, u, v, d)
        d_to = d_to * (d > MIN_DISPARITY_PX).to(d.dtype)
        column, row = (u_to + 0.5) / cell - 0.5, (v_to + 0.5) / cell - 0.5
        moved = d_to[:, None] if level == 0 else values
        warped.append(splat_softmax(moved, column, row, d_to))
    return warped


def warp_state(
    disparity: Tensor, hidden: Tensor, uvd_curr_from_prev: Tensor, *, scale: int, hidden_scale: int
) -> tuple[Tensor, Tensor]:
    """Take the previous frame's disparity and hidden state to the current view.

    Forward splat of the one-channel disparity finds which surface is seen where; from there each
    cell looks back through the inverse transform and takes the disparity between cells and the
    hidden state of the cell it came from. So the many channels are gathered, never splatted, and
    rounding to cells costs the disparity no accuracy.

    Args: ``disparity`` [B, 1, H/s, W/s] px at full resolution, 0 = nothing; ``hidden``
    [B, C, H/s', W/s']; ``uvd_curr_from_prev`` [B, 4, 4]. Returns prior disparity [B, 1, H/s, W/s]
    and hidden state; both are 0 in holes, where nothing is known.
    """
    previous = disparity[:, 0]
    _, height, width = previous.shape
    u, v = cell_centres(height, width, scale, previous)
    u_to, v_to, d_to = transform_uvd(uvd_curr_from_prev, u, v, previous.detach())
    d_to = d_to * (previous > MIN_DISPARITY_PX).to(d_to.dtype)
    column = torch.floor((u_to + 0.5) / scale).clamp(-1, width)
    row = torch.floor((v_to + 0.5) / scale).clamp(-1, height)
    # Geometry passes no gradient, values do: see layers.lookup.
    landed = fill_cracks(splat_nearest(d_to, column, row)).detach()
    seen = (landed > MIN_DISPARITY_PX).to(landed.dtype)

    # The inverse in double: a float32 product of pixel-sized entries would lose the sub-pixel part.
    prev_from_curr = inverse_4x4(uvd_curr_from_prev.double()).to(previous.dtype)
    u_from, v_from, d_from = transform_uvd(prev_from_curr, u, v, landed)
    source_column = (u_from + 0.5) / scale - 0.5
    source_row = (v_from + 0.5) / scale - 0.5
    between = sample_bilinear(previous, source_column, source_row)
    # Between two surfaces the bilinear sample belongs to neither: keep what was splatted.
    smooth = ((between - d_from).abs() < 1.0).to(landed.dtype)
    _, _, refined = transform_uvd(uvd_curr_from_prev, u_from, v_from, between)
    prior = (landed + smooth * (refined - landed)) * seen

    step = hidden_scale // scale
    low = F.max_pool2d(landed[:, None], step)[:, 0]
    low_seen = (low > MIN_DISPARITY_PX).to(low.dtype)[:, None]
    u_low, v_low = cell_centres(low.shape[1], low.shape[2], hidden_scale, low)
    u_low, v_low, _ = transform_uvd(prev_from_curr, u_low, v_low, low)
    carried = sample_nearest(
        hidden, (u_low + 0.5) / hidden_scale - 0.5, (v_low + 0.5) / hidden_scale - 0.5
    )
    return prior[:, None], carried * low_seen
