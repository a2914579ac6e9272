"""The network of `lite`: a wide coarse search and a narrow fine search, joined over time.

The wide search covers every disparity in cells of 1/8. The narrow search weighs a few hypotheses
per cell of 1/4. The previous disparity, warped to the new view, is the prior of the wide search,
and the result of the narrow search is blended with it where the two agree. Choosing and blending
is learned. Matching starts from fixed census descriptors, so the untrained network is already a
stereo matcher.

An iteration contains everything that depends on the prior: both choices and the recurrent cell. Its
result is the prior of the next iteration, and of the next frame. So a second iteration acts like
the same frame seen again, and a network that improves over frames also improves over iterations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from vergence_models.config import LiteNetworkConfig
from vergence_models.networks.base import Estimate, State, StepOutput, StereoNetwork
from vergence_models.networks.cost_volume import whole_rows
from vergence_models.networks.layers import CensusDescriptor, added, all_pairs, banded
from vergence_models.networks.lite.ambiguity import SigmaHead
from vergence_models.networks.lite.coarse import (
    BIN_PX,
    CoarseUpdate,
    CostFeatures,
    CostFilter,
    extremes,
    peak,
    smooth_fill,
)
from vergence_models.networks.lite.context import Context
from vergence_models.networks.lite.hypotheses import Hypotheses
from vergence_models.networks.lite.refinement import Refined, Refinement, near_columns
from vergence_models.networks.lite.search_loss import search_cross_entropy
from vergence_models.networks.lite.upscaled import joined, larger_image, larger_state
from vergence_models.networks.losses import known, masked_mean, output_loss, robust
from vergence_models.networks.warp import warp_state
from vergence_proto.model_io import StateTensor


class LiteState(NamedTuple):
    """The recurrent state, from step to step and from iteration to iteration."""

    disparity: Tensor  # float32 [B, 1, H/4, W/4], full-resolution pixels, 0 = nothing known
    hidden: Tensor  # float32 [B, C, H/8, W/8]


class MatchingFeatures(NamedTuple):
    """Features that depend on the two images alone; computed once for all iterations."""

    cost_features: CostFeatures
    pairs: Tensor  # at 1/4, see Near.pairs
    context4: Tensor  # [B, C, H/4, W/4]
    context8: Tensor
    context16: Tensor  # as the cost filter takes it


class CoarseEstimate(NamedTuple):
    """The disparity of an iteration at one scale below the full one, and its hypotheses."""

    disparity: Tensor  # [B, 1, H/scale, W/scale] px
    hypotheses: Hypotheses
    scale: int

    def loss(self, truth_px: Tensor, max_disparity_px: int) -> Tensor:
        truth = truth_px[:, None, self.scale // 2 :: self.scale, self.scale // 2 :: self.scale]
        error = robust((self.disparity - truth).abs())
        unlikely = self.hypotheses.unlikelihood(truth_px, max_disparity_px, scale=self.scale)
        return 0.3 * masked_mean(error, known(truth, max_disparity_px)) + 0.3 * unlikely


class Iteration(NamedTuple):
    """The results of one iteration."""

    answer: Refined
    hidden: Tensor  # [B, C, H/8, W/8]
    scores: Tensor  # coarse scores, as in LiteEstimate
    coarse_estimates: tuple[CoarseEstimate, CoarseEstimate]


@dataclass(frozen=True, slots=True, eq=False)
class LiteEstimate(Estimate):
    """The estimate, and the inner estimates before it."""

    coarse_scores: Tensor  # [B, H/8, W/8, D]: unnormalised log-probability, largest disparity first
    coarse_estimates: list[CoarseEstimate]  # at both scales, of each iteration

    def loss(self, truth_px: Tensor, max_disparity_px: int) -> Tensor:
        """The sum of losses of disparity, sigma, both inner scales and the coarse scores."""
        loss = output_loss(self.disparity, self.sigma, truth_px, max_disparity_px)
        losses = [each.loss(truth_px, max_disparity_px) for each in self.coarse_estimates]
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
        self.near = near_columns(config.max_disparity_px)
        self.bins = config.max_disparity_px // BIN_PX
        # Last: the optimizer's state is by the order of the weights, and older runs lack these.
        self.sigma_head = SigmaHead()

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
        following = self.moved(LiteState(*state), uvd_curr_from_prev)
        matching = self.search(left, right)
        estimate, following = self.iterated(matching, following, iterations)
        scores = matching.cost_features.fixed
        sigma = self.sigma_head(estimate.sigma, following.disparity, scores)
        return replace(estimate, sigma=sigma), following

    def cold_step(
        self, left: Tensor, right: Tensor, iterations: int, *, at_2x: int = 0
    ) -> StepOutput:
        """As in the base class. The ambiguity is that of the plain size: it has the full range."""
        matching = self.search(left, right)
        nothing = LiteState(*self.cold_state(*left.shape[:3]))
        estimate, state = self.iterated(matching, nothing, iterations - at_2x)
        found = StepOutput(estimate.disparity, estimate.sigma, state)
        found = self.refine_at_2x(left, right, found, at_2x) if at_2x else found
        sigma = self.sigma_head(found.sigma, found.state[0], matching.cost_features.fixed)
        return found._replace(sigma=sigma)

    def refine_at_2x(
        self, left: Tensor, right: Tensor, found: StepOutput, iterations: int
    ) -> StepOutput:
        """As in the base class; sigma is the refinement's, before and after."""
        search = self.search(larger_image(left), larger_image(right))
        state = LiteState(*larger_state(*found.state))
        estimate, state = self.iterated(search, state, iterations)
        at_2x = StepOutput(estimate.disparity, estimate.sigma, state)
        return joined(found, at_2x, self.config.max_disparity_px)

    def iterated(
        self, matching: MatchingFeatures, state: LiteState, iterations: int
    ) -> tuple[LiteEstimate, LiteState]:
        """The estimate after so many iterations, from a state in the view of this frame.

        Its sigma is the refinement's own, without the ambiguity of the match.
        """
        estimates: list[CoarseEstimate] = []
        for _ in range(iterations):
            found = self.iterate(matching, state)
            state = LiteState(found.answer.disparity, found.hidden)
            estimates += found.coarse_estimates
        disparity, sigma = self.refinement.enlarged(found.answer)
        return LiteEstimate(disparity, sigma, found.scores, estimates), state

    def moved(self, state: LiteState, uvd_curr_from_prev: Tensor) -> LiteState:
        """The state of the previous frame in the view of this one."""
        return LiteState(*warp_state(*state, uvd_curr_from_prev, scale=4, hidden_scale=8))

    def search(self, left: Tensor, right: Tensor) -> MatchingFeatures:
        """Compute all that depends on the images alone; uint8 [B, H, W, 3] each."""
        return MatchingFeatures(self.search_wide(left, right), *self.search_narrow(left, right))

    def search_wide(self, left: Tensor, right: Tensor) -> CostFeatures:
        """The inputs of the wide search: all disparities, at 1/8."""
        pairs = all_pairs(
            self.coarse_descriptor(gray(left, 4), 2), self.coarse_descriptor(gray(right, 4), 1)
        )
        return self.cost_filter.cost_features(banded(pairs, self.bins))

    def search_narrow(self, left: Tensor, right: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Pairs at 1/4 and the context: all other fields of :class:`MatchingFeatures`."""
        left_fine = self.fine_descriptor(gray(left, 2), 2)
        right_fine = self.fine_descriptor(gray(right, 2), 1)
        quarter, eighth, sixteenth = self.context(left)
        pairs = self.near.pairs(left_fine, right_fine)
        return pairs, quarter, eighth, self.cost_filter.context(sixteenth)

    def iterate(self, matching: MatchingFeatures, state: LiteState) -> Iteration:
        """Improve the prior disparity by both searches."""
        prior, hidden = state
        seen = (prior > 0).to(prior.dtype)
        seen8 = F.avg_pool2d(seen, 2)
        hole8 = (seen8 <= 0).to(prior.dtype)
        prior8 = F.avg_pool2d(prior, 2) / seen8.clamp(min=0.1)
        scores = whole_rows(self.cost_filter(matching.cost_features, matching.context16, prior8))
        best = peak(scores)
        confidence = torch.exp(4 * best[1])
        fill = smooth_fill(best[0], confidence)
        hidden, d, hypotheses = self.update(
            hidden,
            prior8 + hole8 * (fill - prior8),
            peak=best,
            fills=torch.cat((fill, extremes(best[0], confidence, fill)), dim=1),
            hole=hole8,
            scores=scores,
            context=matching.context8,
        )
        pairs = self.near.volume(matching.pairs)
        answer, chosen_among = self.refinement(pairs, d, hidden, prior, matching.context4)
        estimates = (
            CoarseEstimate(d, hypotheses, 8),
            CoarseEstimate(answer.disparity, chosen_among, 4),
        )
        return Iteration(answer, hidden, scores.scores, estimates)


def gray(image: Tensor, scale: int) -> Tensor:
    """Mean of the colours of blocks of pixels: uint8 [B, H, W, 3] to [B, 1, H/scale, W/scale].

    Two rows represent a block. Their sums are a product with ones, which is fast on bytes.
    """
    batch, height, width, _ = image.shape
    ones = torch.eye(32 // scale, device=image.device).repeat_interleave(3 * scale, dim=0)
    rows = image[:, :: scale // 2].reshape(-1, 96)  # widths are multiples of 32
    sums = torch.matmul(rows.float(), ones).view(batch, height // scale, 2, width // scale)
    return sums.sum(dim=2)[:, None] * (1 / (6 * scale))
