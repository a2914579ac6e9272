"""What a step is trained for: disparity everywhere, and its own error."""

from __future__ import annotations

import torch
from torch import Tensor


def robust(error_px: Tensor) -> Tensor:
    """L1 with a logarithm: far outliers still pull, and halving a small error still pays."""
    return 0.5 * error_px + torch.log1p(error_px)


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of ``values`` where ``mask`` (float) is one; 0 where it is empty."""
    return (values * mask).sum() / mask.sum().clamp(min=1)


def known(truth_px: Tensor, max_disparity_px: int) -> Tensor:
    """1 where the truth is known and within the network's range, as float."""
    return ((truth_px > 0) & (truth_px < max_disparity_px)).to(truth_px.dtype)


def laplace_nll(error_px: Tensor, sigma_px: Tensor) -> Tensor:
    """Negative log-likelihood of an error under a Laplace distribution of scale sigma.

    An error past 20 sigma pulls no harder: one outlier must not drown a batch.
    """
    bounded = torch.minimum(error_px, 20 * sigma_px.detach())
    return bounded / sigma_px + torch.log(sigma_px)


def output_loss(
    disparity: Tensor, sigma: Tensor, truth_px: Tensor, max_disparity_px: int
) -> Tensor:
    """The loss of an answer against ``truth_px``, all [B, H, W]; 0 = unknown truth."""
    mask = known(truth_px, max_disparity_px)
    error = (disparity - truth_px).abs()
    # Sigma learns from the error, and must not buy itself a better one.
    doubt = laplace_nll(error.detach(), sigma)
    return masked_mean(robust(error), mask) + 0.1 * masked_mean(doubt, mask)
