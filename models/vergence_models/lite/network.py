"""The network of `lite`: a wide coarse search, a narrow fine one, and time to join them.

The wide search is coarse (every disparity, cells of 1/8), the narrow one fine (a handful of
hypotheses per cell of 1/4); time joins them: the previous disparity, moved to the new view, is one
more hypothesis in both. Choosing and blending is learned; matching itself starts from fixed census
descriptors, so the untrained network is already a stereo matcher.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from vergence_models.config import LiteNetworkConfig
from vergence_models.layers import CensusDescriptor, all_pairs, banded
from vergence_models.lite.coarse import (
    BIN_PX,
    CoarseUpdate,
    CostFilter,
    far_fill,
    peak,
    smooth_fill,
)
from vergence_models.lite.context import Context
from vergence_models.lite.losses import search_cross_entropy
from vergence_models.lite.refinement import REACH, Refinement
from vergence_models.lite.sharp import FINE_PX, sharp_search
from vergence_models.lite.volume import near_pairs, whole_rows
from vergence_models.losses import known, masked_mean, output_loss, robust
from vergence_models.network import Estimate, State, StereoNetwork
from vergence_models.warp import warp_state
from vergence_proto.model_io import StateTensor


class LiteState(NamedTuple):
    """What one step hands to the next."""

    disparity: Tensor  # float32 [B, 1, H/4, W/4], full-resolution pixels, 0 = nothing known
    hidden: Tensor  # float32 [B, C, H/8, W/8]


@dataclass(frozen=True, slots=True, eq=False)
class LiteEstimate(Estimate):
    """The answer, and the guesses on the way to it."""

    coarse_scores: Tensor  # [B, H/8, W/8, D]: unnormalised log-probability, largest disparity first
    sharp_scores: Tensor  # [B, H/8, W/8, D']: correlation of fine descriptors, as above
    eighths: list[Tensor]  # [B, 1, H/8, W/8] px: the first guess, then after each iteration
    quarter: Tensor  # [B, 1, H/4, W/4] px

    def loss(self, truth_px: Tensor, max_disparity_px: int) -> Tensor:
        """Of the answer, its sigma, both scales on the way, and the coarse scores themselves."""
        loss = output_loss(self.disparity, self.sigma, truth_px, max_disparity_px)
        quarter = truth_px[:, None, 2::4, 2::4]
        error = (self.quarter - quarter).abs()
        loss = loss + 0.3 * masked_mean(robust(error), known(quarter, max_disparity_px))
        eighth = truth_px[:, None, 4::8, 4::8]
        mask = known(eighth, max_disparity_px)
        for inner in self.eighths[1:]:
            loss = loss + 0.3 / (len(self.eighths) - 1) * masked_mean(
                robust((inner - eighth).abs()), mask
            )
        loss = loss + 0.2 * search_cross_entropy(
            self.coarse_scores, truth_px, max_disparity_px, bin_px=BIN_PX
        )
        # A correlation is at most 1: sharpened, it can rule out.
        return loss + 0.05 * search_cross_entropy(
            15 * self.sharp_scores, truth_px, max_disparity_px, bin_px=FINE_PX
        )


class LiteNetwork(StereoNetwork[LiteNetworkConfig]):
    """The step of `lite`."""

    def __init__(self, config: LiteNetworkConfig) -> None:
        super().__init__(config)
        self.fine_descriptor = CensusDescriptor(config.fine_bits, contrast=4.0)
        self.coarse_descriptor = CensusDescriptor(config.coarse_bits, contrast=3.0)
        self.context = Context(config)
        self.cost_filter = CostFilter(config)
        self.update = CoarseUpdate(config)
        self.refinement = Refinement(config)

    @property
    def state_tensors(self) -> tuple[StateTensor, ...]:
        return (StateTensor("disparity", 1, 4), StateTensor("hidden_0", self.config.hidden, 8))

    def forward(
        self,
        left: Tensor,
        right: Tensor,
        uvd_curr_from_prev: Tensor,
        state: State,
        iterations: int,
    ) -> tuple[LiteEstimate, LiteState]:
        previous = LiteState(*state)
        left_rows, right_rows = interleave(left), interleave(right)
        left_half, right_half = half_gray(left_rows), half_gray(right_rows)
        left_fine = self.fine_descriptor(left_half, 2)
        right_fine = self.fine_descriptor(right_half, 1)
        fine = near_pairs(
            left_fine,
            right_fine,
            reach=self.config.max_disparity_px // FINE_PX,
            margin=REACH + 2,
        )
        sharp = sharp_search(left_fine, right_fine, self.config.max_disparity_px // FINE_PX)
        coarse = banded(
            all_pairs(
                self.coarse_descriptor(F.avg_pool2d(left_half, 2), 2),
                self.coarse_descriptor(F.avg_pool2d(right_half, 2), 1),
            ),
            self.config.max_disparity_px // BIN_PX,
        )
        context4, context8, context16 = self.context(left_rows)

        prior, hole, hidden = warp_state(
            previous.disparity, previous.hidden, uvd_curr_from_prev, scale=4, hidden_scale=8
        )
        seen8 = F.avg_pool2d(1 - hole, 2)
        hole8 = (seen8 <= 0).to(prior.dtype)
        prior8 = F.avg_pool2d(prior, 2) / seen8.clamp(min=0.1)

        scores = whole_rows(self.cost_filter(coarse, context16, prior8))
        top = scores.scores.amax(dim=-1)[:, None]
        guess = peak(scores)
        confidence = torch.exp(4 * guess[1])
        fill = smooth_fill(guess[0], confidence)
        far = far_fill(guess[0], confidence, fill)
        d = prior8 + hole8 * (fill - prior8)
        eighths = [guess[0]]
        for _ in range(iterations):
            hidden, d = self.update(
                hidden,
                d,
                guess=guess,
                fill=fill,
                far=far,
                hole=hole8,
                scores=scores,
                top=top,
                context=context8,
            )
            eighths.append(d)
        disparity, sigma, quarter = self.refinement(fine, d, sharp, hidden, prior, context4)
        estimate = LiteEstimate(disparity, sigma, scores.scores, sharp.scores, eighths, quarter)
        return estimate, LiteState(quarter, hidden)


def interleave(image: Tensor) -> Tensor:
    """uint8 [B, H, W, 3] as float [B, 1, H, 3 W]."""
    batch, height, width, _ = image.shape
    return image.reshape(batch, 1, height, 3 * width).float()


def half_gray(rows: Tensor) -> Tensor:
    """Mean of the colours of 2x2 pixels: [B, 1, H, 3 W] to [B, 1, H/2, W/2] in 0..255."""
    return F.avg_pool2d(rows, (2, 6))
