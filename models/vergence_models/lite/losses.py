"""What teaches the features of `lite` early: the right answer among its coarse scores."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from vergence_models.lite.coarse import BIN_PX
from vergence_models.losses import known, masked_mean


def coarse_cross_entropy(scores: Tensor, truth_px: Tensor, max_disparity_px: int) -> Tensor:
    """Cross-entropy of the coarse scores with the disparities inside each cell of 8x8 pixels.

    Four pixels vote for each cell, each for the two bins round its disparity: a cell on an edge has
    two right answers.
    """
    bins = scores.shape[-1]
    votes = truth_px[:, None, 2::4, 2::4]
    votes = F.pixel_unshuffle(votes, 2).permute(0, 2, 3, 1)
    mask = known(votes, max_disparity_px)
    position = (bins - 1 - votes / BIN_PX).clamp(0, bins - 1.001)
    low = torch.floor(position)
    log_p = F.log_softmax(scores, dim=-1)
    below, above = log_p.gather(3, low.long()), log_p.gather(3, low.long() + 1)
    fraction = position - low
    return masked_mean(-(below * (1 - fraction) + above * fraction), mask)
