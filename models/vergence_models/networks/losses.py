"""The losses of a step: its disparity everywhere, and sigma, its own error."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor


def robust(error_px: Tensor) -> Tensor:
    """L1 with a logarithm: far outliers still pull, and halving a small error still pays.

    The last term (Geman and McClure 1987) is the share of bad pixels, over 2 px, made smooth:
    errors of about that size pull most.
    """
    square = error_px.square()
    return 0.25 * error_px + 1.5 * torch.log1p(error_px) + 6 * square / (square + 4)


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of ``values`` where ``mask`` (float) is one; 0 where it is empty."""
    return (values * mask).sum() / mask.sum().clamp(min=1)


def known(truth_px: Tensor, max_disparity_px: int) -> Tensor:
    """1 where the truth is known and within the network's range, as float."""
    return ((truth_px > 0) & (truth_px < max_disparity_px)).to(truth_px.dtype)


def lookup_cross_entropy(scores: Tensor, position: Tensor, mask: Tensor) -> Tensor:
    """Cross-entropy of ``scores`` [B, H, W, N] with right answers ``position`` [B, H, W, K].

    A position between two entries votes for both. ``mask``, of its shape, is 1 where it counts.
    """
    last = scores.shape[-1] - 1
    position = position.clamp(0, last - 0.001)
    low = torch.floor(position)
    log_p = F.log_softmax(scores, dim=-1)
    below, above = log_p.gather(3, low.long()), log_p.gather(3, low.long() + 1)
    fraction = position - low
    return masked_mean(-(below * (1 - fraction) + above * fraction), mask)


def doubt_loss(error_px: Tensor, sigma_px: Tensor) -> Tensor:
    """A loss that is least where half of the errors lie within sigma ln 2 (Laplace distribution).

    It is a difference of logarithms, so the median counts. With the likelihood a few very large
    errors would widen the sigma of everything around them.
    """
    floor_px = 0.02
    return (torch.log(error_px + floor_px) - torch.log(sigma_px * math.log(2) + floor_px)).abs()


def output_loss(
    disparity: Tensor, sigma: Tensor, truth_px: Tensor, max_disparity_px: int
) -> Tensor:
    """The loss of disparity and sigma against ``truth_px``, all [B, H, W]; 0 = unknown truth."""
    mask = known(truth_px, max_disparity_px)
    error = (disparity - truth_px).abs()
    # Sigma learns from the error, and must not buy itself a better one.
    doubt = doubt_loss(error.detach(), sigma)
    return masked_mean(robust(error), mask) + 0.1 * masked_mean(doubt, mask)
