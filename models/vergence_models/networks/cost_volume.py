"""Volumes of matching scores, and reading them at positions between their entries.

Only pairs that a disparity can have are matched, and reading is one flat gather for all positions
of a cell with the cells as last axes: onnxruntime spends its time on the memory that is written,
on gathers along an axis and on transposes.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

BLOCKS = 8  # blocks of columns: widths are multiples of 32, so cells of 1/4 divide into them


class Volume(NamedTuple):
    """For each cell the scores of a window of its row: entries ``first`` to ``first + window - 1``.

    In a row of the image, entry e of the cell x stands at ``begin[x] + stride * (e - first[x])``.
    """

    scores: Tensor  # [B, H, ...]
    begin: Tensor  # [W], float
    first: Tensor  # [W], float
    stride: int
    window: int
    last: int  # the row's last entry; outside of 0 .. last every score is 0


def whole_rows(scores: Tensor) -> Volume:
    """A volume whose windows are all of the row, ``scores`` [B, H, W, N]."""
    width, count = scores.shape[2:]
    begin = torch.arange(width, device=scores.device).to(scores.dtype) * count
    return Volume(scores, begin, torch.zeros_like(begin), 1, count, count - 1)


class Near(NamedTuple):
    """The right entries that a left cell is matched with: up to ``reach`` to the left of its own.

    The window extends by ``margin`` on either side, and by a little more, since all cells of a
    block of columns share one window.
    """

    ratio: int  # right entries per left cell
    reach: int
    margin: int

    @property
    def before(self) -> int:
        """In cells, as wide as left ones, whose entries are copied at once with all channels."""
        return -(-(self.reach + self.margin) // self.ratio)

    @property
    def after(self) -> int:
        return -(-self.margin // self.ratio)

    def pairs(self, left: Tensor, right: Tensor) -> Tensor:
        """Mean products of descriptors [B, C, H, W] and [B, C, H, ratio W].

        Of each block of columns its window of entries and its cells, [B, H, BLOCKS, N, W / BLOCKS].
        What lies outside of the row is not masked.
        """
        batch, channels, height, width = left.shape
        ratio, block = self.ratio, width // BLOCKS
        start = torch.arange(BLOCKS, device=left.device) * block - self.before
        cells = torch.arange(self.before + block + self.after, device=left.device)
        cells = (cells + start[:, None]).clamp(0, width - 1)
        # The mean's division comes first: all operators after it copy, which works on bytes too.
        left_rows = (left * (1 / channels)).permute(0, 2, 1, 3)
        left_rows = left_rows.reshape(batch, height, channels, BLOCKS, block).transpose(2, 3)
        right_rows = right.permute(0, 2, 3, 1).reshape(batch, height, width, ratio * channels)
        right_rows = right_rows.index_select(2, cells.flatten())
        window = ratio * (self.before + block + self.after)
        right_rows = right_rows.view(batch, height, BLOCKS, window, channels)
        return torch.matmul(right_rows, left_rows)

    def volume(self, pairs: Tensor) -> Volume:
        """A volume from the result of :meth:`pairs`."""
        count, block = pairs.shape[3:]
        blocks = torch.arange(BLOCKS, device=pairs.device)[:, None]
        within = torch.arange(block, device=pairs.device)
        begin = (blocks * (count * block) + within).flatten().to(pairs.dtype)
        first = (self.ratio * (blocks * block - self.before)).expand(-1, block).flatten()
        last = self.ratio * BLOCKS * block - 1
        return Volume(pairs, begin, first.to(pairs.dtype), block, count, last)


def lookup(volume: Volume, position: Tensor) -> Tensor:
    """Linear interpolation at ``position`` [B, K, H, W], in entries; the result is of that shape.

    No gradient flows to the position: a disparity learns from its own loss. A gradient through
    the lookup would blow up over iterations and frames.
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
    batch, height = volume.scores.shape[:2]
    # Row by row, so that a row is still in the cache when its next entry is read.
    by_row = (entry.transpose(1, 2) - volume.first).clamp(0, volume.window - 1)
    by_row = by_row * volume.stride + volume.begin
    # For single entries onnxruntime's GatherElements is four times as fast as its Gather of slices.
    rows = volume.scores.reshape(batch * height, -1)
    found = rows.gather(1, by_row.long().reshape(batch * height, -1))
    return found.view(by_row.shape).transpose(1, 2)
