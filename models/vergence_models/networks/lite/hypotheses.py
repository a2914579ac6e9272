"""A few candidate disparities of each cell and their weights, at 1/8 and at 1/4."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from vergence_models.networks.layers import expected
from vergence_models.networks.losses import known, masked_mean


class Hypotheses(NamedTuple):
    """Disparities of each cell, [B, K, H, W] px, and logits of their shares, of the same shape."""

    surfaces: Tensor
    scores: Tensor

    def mean(self) -> Tensor:
        """[B, 1, H, W] px."""
        return expected(self.scores, self.surfaces)

    def unlikelihood(self, truth_px: Tensor, max_disparity_px: int, *, scale: int) -> Tensor:
        """Negative log-likelihood of the truth [B, H, W], a scalar.

        Each hypothesis is the centre of a Laplace distribution. The error of the mean says little
        about which hypothesis was right, and nothing about one with almost no weight; the
        likelihood does, for near and far hypotheses alike. Four pixels of each cell of 1/``scale``
        vote. No gradient flows to the disparities.
        """
        log_shares = F.log_softmax(self.scores, dim=1)
        first, second = scale // 4, 3 * scale // 4
        unlikely, counted = [], []
        for dy, dx in ((first, first), (first, second), (second, first), (second, second)):
            vote = truth_px[:, None, dy::scale, dx::scale]
            misses = (self.surfaces.detach() - vote).abs() * (8 / scale)
            unlikely.append(-torch.logsumexp(log_shares - misses, dim=1, keepdim=True))
            counted.append(known(vote, max_disparity_px))
        return masked_mean(torch.cat(unlikely, dim=1), torch.cat(counted, dim=1))
