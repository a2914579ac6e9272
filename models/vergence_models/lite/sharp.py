"""A second wide search at 1/8, by fine descriptors: it finds what is too thin for the coarse one.

No filter, no learning of its own: the winner takes all, and is one hypothesis among others.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from vergence_models.layers import all_pairs, banded

FINE_PX = 2  # spacing of the fine descriptors along the right row, and so of the disparities


class SharpSearch(NamedTuple):
    """What the fine descriptors of each 2x2 cells of 1/4 say together."""

    scores: Tensor  # [B, H/8, W/8, D]: mean correlation, largest disparity first
    disparity: Tensor  # [B, 1, H/8, W/8] px: the winner
    correlation: Tensor  # [B, 1, H/8, W/8]: its score


def sharp_search(left: Tensor, right: Tensor, disparities: int) -> SharpSearch:
    """``left`` [B, bits, H/4, W/4] against ``right`` [B, bits, H/4, W/2], an entry every 2 px."""
    batch, bits, height, columns = right.shape
    # The cells of a block lie one above, one beside the other; beside is two entries further.
    both = torch.stack((right, F.pad(right[..., 2:], (0, 2))), dim=2)
    blocks = both.view(batch, bits, 2, height // 2, 2, columns).permute(0, 1, 4, 2, 3, 5)
    blocks = blocks.reshape(batch, 4 * bits, height // 2, columns)
    scores = banded(all_pairs(F.pixel_unshuffle(left, 2), blocks), disparities)
    correlation, best = scores.max(dim=-1)
    disparity = (disparities - 1 - best).to(scores.dtype) * FINE_PX
    return SharpSearch(scores, disparity[:, None], correlation[:, None])


def rims(d: Tensor) -> Tensor:
    """The largest and the smallest disparity of 3x3 cells: [B, 1, H, W] to [B, 2, H, W]."""
    return torch.cat((F.max_pool2d(d, 3, 1, 1), -F.max_pool2d(-d, 3, 1, 1)), dim=1)
