"""A loss on the scores of the search, which teaches the features of `lite` early in training."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

from vergence_models.networks.losses import known, lookup_cross_entropy


def search_cross_entropy(
    scores: Tensor, truth_px: Tensor, max_disparity_px: int, *, bin_px: int
) -> Tensor:
    """Cross-entropy of scores [B, H/8, W/8, D] with the disparities inside each cell of 8x8 pixels.

    Four pixels vote for each cell, each for the two bins round its disparity: a cell on an edge has
    two right answers.
    """
    bins = scores.shape[-1]
    votes = truth_px[:, None, 2::4, 2::4]
    votes = F.pixel_unshuffle(votes, 2).permute(0, 2, 3, 1)
    position = bins - 1 - votes / bin_px
    return lookup_cross_entropy(scores, position, known(votes, max_disparity_px))
