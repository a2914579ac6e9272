"""The network of `lite`: a wide coarse search, a narrow fine one, and time to join them.

The wide search is coarse (every disparity, cells of 1/8), the narrow one fine (a handful of
hypotheses per cell of 1/4); time joins them: the previous disparity, moved to the new view, is what
the wide search starts from, and what the answer of the narrow one is blended with where they agree.
Choosing and blending is learned; matching itself starts from fixed census descriptors, so the
untrained network is already a stereo matcher.

An iteration is all that depends on what is expected: both choices and the recurrent cell. The next
iteration expects its answer, as the next frame does; so a second one is what seeing the same frame
again would be, and a network that improves over frames improves over iterations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from vergence_models.config import LiteNetworkConfig
from vergence_models.layers import CensusDescriptor, added, all_pairs, banded
from vergence_models.lite.coarse import (
    BIN_PX,
    CoarseUpdate,
    CostFilter,
    far_fill,
    peak,
    smooth_fill,
)
from vergence_models.lite.context import Context
from vergence_models.lite.hypotheses import Hypotheses
from vergence_models.lite.losses import search_cross_entropy
from vergence_models.lite.refinement import FINE_PX, REACH, Refined, Refinement
from vergence_models.lite.volume import Volume, near_pairs, whole_rows
from vergence_models.losses import known, masked_mean, output_loss, robust
from vergence_models.network import Estimate, State, StereoNetwork
from vergence_models.warp import warp_state
from vergence_proto.model_io import StateTensor


class LiteState(NamedTuple):
    """What one step hands to the next, and within it one iteration to the next."""

    disparity: Tensor  # float32 [B, 1, H/4, W/4], full-resolution pixels, 0 = nothing known
    hidden: Tensor  # float32 [B, C, H/8, W/8]


class Evidence(NamedTuple):
    """What two images say by themselves: made once, whatever the iterations."""

    fine: Volume  # at 1/4
    coarse: Tensor  # [B, H/8, W/8, D]: correlation, largest disparity first
    context4: Tensor  # [B, C, H/4, W/4]
    context8: Tensor
    context16: Tensor


class Guess(NamedTuple):
    """What an iteration found at one scale, and what it chose among."""

    disparity: Tensor  # [B, 1, H/scale, W/scale] px
    hypotheses: Hypotheses
    scale: int

    def loss(self, truth_px: Tensor, max_disparity_px: int) -> Tensor:
        truth = truth_px[:, None, self.scale // 2 :: self.scale, self.scale // 2 :: self.scale]
        error = robust((self.disparity - truth).abs())
        unlikely = self.hypotheses.unlikelihood(truth_px, max_disparity_px, scale=self.scale)
        return 0.3 * masked_mean(error, known(truth, max_disparity_px)) + 0.3 * unlikely


class Iteration(NamedTuple):
    """What one iteration found."""

    answer: Refined
    hidden: Tensor  # [B, C, H/8, W/8]
    scores: Tensor  # of the wide search, as in LiteEstimate
    guesses: tuple[Guess, Guess]


@dataclass(frozen=True, slots=True, eq=False)
class LiteEstimate(Estimate):
    """The answer, and the guesses on the way to it."""

    coarse_scores: Tensor  # [B, H/8, W/8, D]: unnormalised log-probability, largest disparity first
    guesses: list[Guess]  # at both scales, of each iteration

    def loss(self, truth_px: Tensor, max_disparity_px: int) -> Tensor:
        """Of the answer, its sigma, both scales on the way, and the coarse scores themselves."""
        loss = output_loss(self.disparity, self.sigma, truth_px, max_disparity_px)
        losses = [guess.loss(truth_px, max_disparity_px) for guess in self.guesses]
        loss = loss + 2 / len(losses) * added(losses)
        search = search_cross_entropy(self.coarse_scores, truth_px, max_disparity_px, bin_px=BIN_PX)
        return loss + 0.2 * search


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
        evidence = self.search(left, right)
        disparity, hidden = LiteState(*state)
        moved = warp_state(disparity, hidden, uvd_curr_from_prev, scale=4, hidden_scale=8)
        following = LiteState(*moved)
        guesses: list[Guess] = []
        for _ in range(iterations):
            found = self.iterate(evidence, following)
            following = LiteState(found.answer.disparity, found.hidden)
            guesses += found.guesses
        disparity, sigma = self.refinement.enlarged(found.answer)
        return LiteEstimate(disparity, sigma, found.scores, guesses), following

    def search(self, left: Tensor, right: Tensor) -> Evidence:
        """What the images say by themselves; [B, H, W, 3] uint8 each."""
        left_rows, right_rows = interleave(left), interleave(right)
        left_half, right_half = half_gray(left_rows), half_gray(right_rows)
        left_fine = self.fine_descriptor(left_half, 2)
        right_fine = self.fine_descriptor(right_half, 1)
        reach = self.config.max_disparity_px // FINE_PX
        fine = near_pairs(left_fine, right_fine, reach=reach, margin=REACH + 2)
        pairs = all_pairs(
            self.coarse_descriptor(F.avg_pool2d(left_half, 2), 2),
            self.coarse_descriptor(F.avg_pool2d(right_half, 2), 1),
        )
        coarse = banded(pairs, self.config.max_disparity_px // BIN_PX)
        return Evidence(fine, coarse, *self.context(left_rows))

    def iterate(self, evidence: Evidence, state: LiteState) -> Iteration:
        """From the surface that is expected to a better one, by both searches."""
        prior, hidden = state
        seen = (prior > 0).to(prior.dtype)
        seen8 = F.avg_pool2d(seen, 2)
        hole8 = (seen8 <= 0).to(prior.dtype)
        prior8 = F.avg_pool2d(prior, 2) / seen8.clamp(min=0.1)
        scores = whole_rows(self.cost_filter(evidence.coarse, evidence.context16, prior8))
        guess = peak(scores)
        confidence = torch.exp(4 * guess[1])
        fill = smooth_fill(guess[0], confidence)
        far = far_fill(guess[0], confidence, fill)
        hidden, d, hypotheses = self.update(
            hidden,
            prior8 + hole8 * (fill - prior8),
            guess=guess,
            fill=fill,
            far=far,
            hole=hole8,
            scores=scores,
            context=evidence.context8,
        )
        answer = self.refinement(evidence.fine, d, hidden, prior, evidence.context4)
        guesses = Guess(d, hypotheses, 8), Guess(answer.disparity, answer.hypotheses, 4)
        return Iteration(answer, hidden, scores.scores, guesses)


def interleave(image: Tensor) -> Tensor:
    """uint8 [B, H, W, 3] as float [B, 1, H, 3 W]."""
    batch, height, width, _ = image.shape
    return image.reshape(batch, 1, height, 3 * width).float()


def half_gray(rows: Tensor) -> Tensor:
    """Mean of the colours of 2x2 pixels: [B, 1, H, 3 W] to [B, 1, H/2, W/2] in 0..255."""
    return F.avg_pool2d(rows, (2, 6))
