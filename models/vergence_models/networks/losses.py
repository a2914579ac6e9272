"""The losses of a step: its disparity everywhere, and sigma, its own error."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

# The share of errors within so many sigma, of a Laplace distribution.
WITHIN_SIGMAS = {sigmas: 1 - math.exp(-sigmas) for sigmas in (1, 2, 3)}
BEYOND_PX = 32.0


def robust(error_px: Tensor) -> Tensor:
    """L1 with a logarithm: far outliers still pull, and halving a small error still pays.

    The last term (Geman and McClure 1987) is the share of bad pixels, over 2 px, made smooth:
    errors of about that size pull most.
    """
    square = error_px.square()
    return 0.25 * error_px + 1.5 * torch.log1p(error_px) + 6 * square / (square + 4)


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of ``values`` weighted by ``mask`` (float, 0 or at least 1); 0 where it is empty."""
    return (values * mask).sum() / mask.sum().clamp(min=1)


def known(truth_px: Tensor, max_disparity_px: int) -> Tensor:
    """1 where the truth is known and within the network's range, as float."""
    return ((truth_px > 0) & (truth_px < max_disparity_px)).to(truth_px.dtype)


def edge_weight(truth_px: Tensor) -> Tensor:
    """2 within four pixels of a depth edge, a step of more than 3 px, and 1 elsewhere: [B, H, W].

    There are few such pixels, but most of the large errors are there.
    """
    planes = truth_px[:, None].clamp(min=0)
    nearest, farthest = (sign * F.max_pool2d(sign * planes, 9, 1, 4) for sign in (1, -1))
    return 1 + (nearest - farthest > 3)[:, 0].to(truth_px.dtype)


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
    """A loss that is least where 63, 86 and 95 % of the errors lie within 1, 2 and 3 sigma.

    So it is for a Laplace distribution, whose mean absolute error is sigma. Each is a quantile loss
    (Koenker and Bassett 1978) of logarithms. With the likelihood a few very large errors would
    widen the sigma of everything around them.
    """
    floor_px = 0.02
    error = torch.log(error_px + floor_px)
    loss = torch.zeros_like(error)
    for sigmas, share in WITHIN_SIGMAS.items():
        over = error - torch.log(sigmas * sigma_px + floor_px)
        loss = loss + torch.maximum(share * over, (share - 1) * over)
    return loss


def judged_error(disparity: Tensor, truth_px: Tensor, max_disparity_px: int) -> Tensor:
    """The error that sigma is to expect, px, of the shape of both, [B, H, W].

    A negative truth says that the images do not show the disparity, and is one that is possible.
    The error of a truth beyond the range counts :data:`BEYOND_PX` at least: no value can be right.
    """
    # Sigma learns from the error, and must not buy itself a better one.
    error = (disparity.detach() - truth_px.abs()).abs()
    beyond = truth_px.abs() >= max_disparity_px
    return torch.where(beyond, error.clamp(min=BEYOND_PX), error)


def sigma_loss(disparity: Tensor, sigma: Tensor, truth_px: Tensor, max_disparity_px: int) -> Tensor:
    """The loss of sigma against ``truth_px`` as :func:`judged_error` has it, a scalar."""
    error = judged_error(disparity, truth_px, max_disparity_px)
    return masked_mean(doubt_loss(error, sigma), (truth_px != 0).to(error.dtype))


def output_loss(
    disparity: Tensor, sigma: Tensor, truth_px: Tensor, max_disparity_px: int
) -> Tensor:
    """The loss of disparity and sigma against ``truth_px``, all [B, H, W]; 0 = unknown truth."""
    weight = known(truth_px, max_disparity_px) * edge_weight(truth_px)
    error = masked_mean(robust((disparity - truth_px).abs()), weight)
    return error + 0.1 * sigma_loss(disparity, sigma, truth_px, max_disparity_px)
