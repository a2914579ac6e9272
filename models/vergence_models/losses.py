"""What a step is trained for: disparity everywhere, its own error, and good inner estimates."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from vergence_models.network import BIN_PX, Estimate


def robust(error_px: Tensor) -> Tensor:
    """L1 with a logarithm: far outliers still pull, and halving a small error still pays."""
    return 0.5 * error_px + torch.log1p(error_px)


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of ``values`` where ``mask`` (float) is one; 0 where it is empty."""
    return (values * mask).sum() / mask.sum().clamp(min=1)


def known(truth_px: Tensor, max_disparity_px: int) -> Tensor:
    """1 where the truth is known and within the network's range, as float."""
    return ((truth_px > 0) & (truth_px < max_disparity_px)).to(truth_px.dtype)


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


def laplace_nll(error_px: Tensor, sigma_px: Tensor) -> Tensor:
    """Negative log-likelihood of an error under a Laplace distribution of scale sigma.

    An error past 20 sigma pulls no harder: one outlier must not drown a batch.
    """
    bounded = torch.minimum(error_px, 20 * sigma_px.detach())
    return bounded / sigma_px + torch.log(sigma_px)


def step_loss(estimate: Estimate, truth_px: Tensor, max_disparity_px: int) -> Tensor:
    """The loss of one step against ``truth_px`` [B, H, W] (0 = unknown)."""
    mask = known(truth_px, max_disparity_px)
    error = (estimate.disparity - truth_px).abs()
    loss = masked_mean(robust(error), mask)
    # Sigma learns from the error, and must not buy itself a better one.
    loss = loss + 0.1 * masked_mean(laplace_nll(error.detach(), estimate.sigma), mask)
    quarter = truth_px[:, None, 2::4, 2::4]
    error = (estimate.quarter - quarter).abs()
    loss = loss + 0.3 * masked_mean(robust(error), known(quarter, max_disparity_px))
    eighth = truth_px[:, None, 4::8, 4::8]
    mask = known(eighth, max_disparity_px)
    for inner in estimate.eighths[1:]:
        loss = loss + 0.3 / (len(estimate.eighths) - 1) * masked_mean(
            robust((inner - eighth).abs()), mask
        )
    return loss + 0.2 * coarse_cross_entropy(estimate.coarse_scores, truth_px, max_disparity_px)
