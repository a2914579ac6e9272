"""Volumes of matching scores, and reading them at positions between their entries.

Only pairs that a disparity can have are matched, and reading is one flat gather for all positions
of a cell with the cells as last axes: onnxruntime spends its time on the memory that is written,
on gathers along an axis and on transposes.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

BLOCK = 20  # columns that share a window; even, for the cells of 1/8


class Volume(NamedTuple):
    """For each cell the scores of a window of its row: entries ``first`` to ``first + N - 1``."""

    scores: Tensor  # [..., N], the cells in any order
    begin: Tensor  # [B, 1, H, W] int64: where a cell's window is in the flattened scores
    first: Tensor  # [W], float
    last: int  # the row's last entry; outside of 0 .. last every score is 0


def whole_rows(scores: Tensor) -> Volume:
    """A volume whose windows are all of the row, ``scores`` [B, H, W, N]."""
    batch, height, width, window = scores.shape
    begin = torch.arange(batch * height * width, device=scores.device) * window
    first = torch.zeros(width, dtype=scores.dtype, device=scores.device)
    return Volume(scores, begin.view(batch, 1, height, width), first, window - 1)


def near_pairs(left: Tensor, right: Tensor, *, reach: int, margin: int) -> Volume:
    """Mean products of descriptors [B, C, H, W] and [B, C, H, r W] that are near in their row.

    The left cell x meets the right entries from r x - reach - margin to r x + margin, some more at
    either end: a block of columns shares its window. What lies outside of the row is not masked.
    H is even: the scores are [B H/2, blocks, 2, BLOCK, N], two rows of a block side by side.
    """
    batch, channels, height, width = left.shape
    ratio = right.shape[3] // width
    blocks = (width + BLOCK - 1) // BLOCK
    window = ratio * BLOCK + reach + 2 * margin

    def in_blocks(descriptors: Tensor, start: Tensor, count: int) -> Tensor:
        """Of each block ``count`` entries of both rows from ``start`` on: [.., 2, count, C]."""
        entries = descriptors.shape[3]
        index = (start[:, None] + torch.arange(count, device=start.device)).clamp(0, entries - 1)
        index = index[:, None] + torch.tensor([[0], [1]], device=start.device) * entries
        # With its channels side by side a descriptor is copied at once.
        rows = descriptors.permute(0, 2, 3, 1).reshape(-1, 2 * entries, channels)
        return rows.index_select(1, index.flatten()).view(-1, blocks, 2, count, channels)

    block = torch.arange(blocks, device=left.device)
    start = block * (ratio * BLOCK) - (reach + margin)
    left_rows, right_rows = in_blocks(left, block * BLOCK, BLOCK), in_blocks(right, start, window)
    scores = torch.matmul(left_rows, right_rows.transpose(3, 4)) * (1 / channels)
    x = torch.arange(width, device=left.device)
    y = torch.arange(batch * height, device=left.device)[:, None]
    begin = ((y // 2 * blocks + x // BLOCK) * 2 + y % 2) * BLOCK + x % BLOCK
    first = start.to(left.dtype).index_select(0, x // BLOCK)
    begin = begin.view(batch, 1, height, width) * window
    return Volume(scores, begin, first, ratio * width - 1)


def lookup(volume: Volume, position: Tensor) -> Tensor:
    """Linear interpolation at ``position`` [B, K, H, W], in entries; the result is of that shape.

    No gradient flows to the position: a disparity learns from its own loss, not from wishing to
    have been looked up elsewhere, which would blow up over iterations and frames.
    """
    position = position.detach()
    low = torch.floor(position)
    inside = (low == low.clamp(0, volume.last - 1)).to(position.dtype)
    below, above = gathered(volume, torch.cat((low, low + 1), dim=1)).chunk(2, dim=1)
    return (below + (above - below) * (position - low)) * inside


def lookup_row(volume: Volume, position: Tensor, reach: int) -> Tensor:
    """Interpolate at ``position`` [B, 1, H, W] and ``reach`` entries to either side of it.

    Returns [B, 2 reach + 1, H, W]. Neighbours share their entries, which halves the gathers.
    """
    position = position.detach()
    low = torch.floor(position)
    steps = torch.arange(-reach, reach + 2, device=position.device).to(position.dtype)
    entry = low + steps[:, None, None]
    inside = (entry == entry.clamp(0, volume.last)).to(position.dtype)
    entries = gathered(volume, entry) * inside
    below, above = entries[:, :-1], entries[:, 1:]
    return below + (above - below) * (position - low)


def gathered(volume: Volume, entry: Tensor) -> Tensor:
    """The scores at whole entries [B, K, H, W], float; the nearest in the window if it has none."""
    window = volume.scores.shape[-1]
    index = (entry - volume.first).clamp(0, window - 1).long() + volume.begin
    # Row by row, so that a row is still in the cache when its next entry is read.
    by_row = index.transpose(1, 2)
    # One entry each: onnxruntime's gather of elements is four times as quick as that of slices.
    found = volume.scores.flatten().gather(0, by_row.flatten())
    return found.view(by_row.shape).transpose(1, 2)
