"""A second wide search at 1/8, by fine descriptors: it finds what is too thin for the coarse one.

No filter, no learning of its own: the winner takes all, and is one hypothesis among others.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from vergence_models.lite.volume import BLOCK, Volume

FINE_PX = 2  # spacing of the fine descriptors along the right row, and so of the disparities
CELLS = 4  # of the fine volume that vote together
NEVER = -1e2  # the score of what is no disparity


class SharpSearch(NamedTuple):
    """What the fine descriptors of each 2x2 cells of 1/4 say together."""

    sums: Tensor  # [B, H/8, W/8, N]: of four correlations, with entries of the right row
    columns: Tensor  # [W/8, D]: where in them the disparities are, the largest first
    disparity: Tensor  # [B, 1, H/8, W/8] px: the winner
    correlation: Tensor  # [B, 1, H/8, W/8]: its mean score

    def scores(self) -> Tensor:
        """[B, H/8, W/8, D]: mean correlation, largest disparity first."""
        batch, height = self.sums.shape[:2]
        return self.sums.gather(3, self.columns.expand(batch, height, -1, -1)) * (1 / CELLS)


def sharp_search(fine: Volume, disparities: int) -> SharpSearch:
    """Of the volume of :func:`near_pairs` at 1/4, whose rows have an entry every 2 px."""
    batch, _, height, width = fine.begin.shape
    rows, blocks, _, _, window = fine.scores.shape
    # The cells of a block lie one above, one beside the other; beside is two entries further.
    above = fine.scores.sum(dim=2).view(rows, blocks, BLOCK // 2, 2 * window)
    sums = above[..., : window - 2] + above[..., window + 2 :]
    entry = torch.arange(window - 2, device=sums.device)
    first = fine.first[0].long()
    zero = 4 * torch.arange(BLOCK // 2, device=sums.device)[:, None] - first
    d = zero - entry
    start = torch.arange(blocks, device=sums.device)[:, None, None] * (2 * BLOCK) + first
    inside = (start + entry >= 0).to(sums.dtype)
    excluded = ((d < 0) | (d >= disparities)).to(sums.dtype) * NEVER
    sums = sums * inside + excluded
    correlation, best = sums.max(dim=-1)
    disparity = (zero[:, 0] - best).to(sums.dtype) * FINE_PX
    largest_first = zero - torch.arange(disparities - 1, -1, -1, device=sums.device)

    def in_rows(values: Tensor) -> Tensor:
        """[B H/8, blocks, BLOCK / 2, ..] to [B, H/8, W/8, ..]."""
        joined = values.reshape(batch, height // 2, blocks * BLOCK // 2, *values.shape[3:])
        return joined[:, :, : width // 2]

    return SharpSearch(
        in_rows(sums),
        largest_first.repeat(blocks, 1)[: width // 2],
        in_rows(disparity)[:, None],
        in_rows(correlation)[:, None] * (1 / CELLS),
    )


def rims(d: Tensor) -> Tensor:
    """The largest and the smallest disparity of 3x3 cells: [B, 1, H, W] to [B, 2, H, W]."""
    return torch.cat((F.max_pool2d(d, 3, 1, 1), -F.max_pool2d(-d, 3, 1, 1)), dim=1)
