"""Volumes of matching scores, and reading them at positions between their entries.

Only pairs that a disparity can have are matched, and reading is one flat gather for all positions
of a cell with the cells as last axes: onnxruntime spends its time on the memory that is written,
on gathers along an axis and on transposes.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

BLOCKS = 8  # of columns: images are as wide as multiples of 32, so cells of 1/4 divide into them


class Volume(NamedTuple):
    """For each cell the scores of a window of its row: entries ``first`` to ``first + N - 1``."""

    scores: Tensor  # [B, H, W, N]
    first: Tensor  # [W], float
    last: int  # the row's last entry; outside of 0 .. last every score is 0


def whole_rows(scores: Tensor) -> Volume:
    """A volume whose windows are all of the row, ``scores`` [B, H, W, N]."""
    first = torch.zeros(scores.shape[2], dtype=scores.dtype, device=scores.device)
    return Volume(scores, first, scores.shape[3] - 1)


def near_pairs(left: Tensor, right: Tensor, *, reach: int, margin: int) -> Volume:
    """Mean products of descriptors [B, C, H, W] and [B, C, H, r W] that are near in their row.

    The left cell x meets the right entries from r x - reach - margin to r x + margin, some more at
    either end: a block of columns shares its window. What lies outside of the row is not masked.
    """
    batch, channels, height, width = left.shape
    ratio = right.shape[3] // width
    block = width // BLOCKS
    # In cells, as wide as left ones, whose entries are copied at once with all their channels.
    before, after = -(-(reach + margin) // ratio), -(-margin // ratio)
    start = torch.arange(BLOCKS, device=left.device) * block - before
    cells = torch.arange(before + block + after, device=left.device) + start[:, None]
    left_rows = left.permute(0, 2, 3, 1).reshape(batch, height, BLOCKS, block, channels)
    right_rows = right.permute(0, 2, 3, 1).reshape(batch, height, width, ratio * channels)
    right_rows = right_rows.index_select(2, cells.clamp(0, width - 1).flatten())
    window = ratio * (before + block + after)
    right_rows = right_rows.view(batch, height, BLOCKS, window, channels)
    # Of a product, onnxruntime does the division on the way.
    scores = torch.matmul(left_rows, right_rows.transpose(3, 4)) * (1 / channels)
    first = (ratio * start)[:, None].expand(-1, block).reshape(width).to(left.dtype)
    return Volume(scores.view(batch, height, width, window), first, ratio * width - 1)


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
    batch, height, width, window = volume.scores.shape
    begin = torch.arange(width, device=entry.device).to(entry.dtype) * window
    # Row by row, so that a row is still in the cache when its next entry is read.
    by_row = (entry.transpose(1, 2) - volume.first).clamp(0, window - 1) + begin
    # Of single entries onnxruntime's gather of elements is four times as quick as that of slices.
    rows = volume.scores.reshape(batch * height, width * window)
    found = rows.gather(1, by_row.long().reshape(batch * height, -1))
    return found.view(by_row.shape).transpose(1, 2)
