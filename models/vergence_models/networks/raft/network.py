"""The network of `full` and `fast`, after "Stereo Matching in Time" (Cheng, Yang, Li; WACV 2024).

RAFT-Stereo's realtime network, with iterations that continue over frames: disparity and both hidden
states of the previous frame are warped to the new view and take one more iteration. Cells without a
warped state, and cold starts, begin from the context of the new image.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch.nn.functional as F
from torch import Tensor, nn

from vergence_models.config import RaftNetworkConfig
from vergence_models.networks.base import Estimate, State, StereoNetwork
from vergence_models.networks.layers import silent
from vergence_models.networks.losses import known, lookup_cross_entropy, masked_mean, sigma_loss
from vergence_models.networks.raft.encoder import Encoder
from vergence_models.networks.raft.update import (
    CELL_PX,
    RaftUpsampler,
    Update,
    correlation,
    pyramid,
    right_column,
)
from vergence_models.networks.warp import splat_levels
from vergence_proto.model_io import StateTensor

MIN_PX = 0.1  # the smallest disparity of a result
TYPICAL_PX = 16.0  # the first disparity of an untrained network


class RaftState(NamedTuple):
    """The recurrent state."""

    disparity: Tensor  # float32 [B, 1, H/8, W/8], full-resolution pixels, 0 = nothing known
    hidden8: Tensor  # float32 [B, C, H/8, W/8]
    hidden16: Tensor  # float32 [B, C, H/16, W/16]


class RaftGiven(NamedTuple):
    """The inputs that all iterations of a frame share."""

    pairs: Tensor  # [B, H/8, W/8, W/8]: correlation of left and right cells
    gates8: Tensor  # [B, 3 C, H/8, W/8]
    gates16: Tensor  # [B, 3 C, H/16, W/16]


@dataclass(frozen=True, slots=True, eq=False)
class RaftEstimate(Estimate):
    """The estimate, and the inner estimates before it."""

    pairs: Tensor  # [B, H/8, W/8, W/8]: correlation of left and right cells
    first: Tensor  # [B, 1, H/8, W/8] px: predicted from the context alone
    eighths: list[Tensor]  # [B, 1, H/8, W/8] px: after each iteration

    def loss(self, truth_px: Tensor, max_disparity_px: int) -> Tensor:
        """L1 of the result as in the paper, plus smaller losses of the inner estimates.

        Later iterations weigh more. The cross-entropy of the correlation teaches the features
        before any iteration can.
        """
        mask = known(truth_px, max_disparity_px)
        error = (self.disparity - truth_px).abs()
        loss = masked_mean(error, mask)
        loss = loss + 0.1 * sigma_loss(self.disparity, self.sigma, truth_px, max_disparity_px)
        eighth = truth_px[:, None, 4::8, 4::8]
        mask = known(eighth, max_disparity_px)
        loss = loss + 0.1 * masked_mean((self.first - eighth).abs(), mask)
        for later, inner in enumerate(reversed(self.eighths)):
            loss = loss + 0.5 * 0.8**later * masked_mean((inner - eighth).abs(), mask)
        return loss + 0.3 * lookup_cross_entropy(
            self.pairs, right_column(eighth).permute(0, 2, 3, 1), mask.permute(0, 2, 3, 1)
        )


class RaftNetwork(StereoNetwork[RaftNetworkConfig]):
    """The step of `full` and `fast`."""

    def __init__(self, config: RaftNetworkConfig) -> None:
        super().__init__(config)
        self.encoder = Encoder(config)
        self.first = nn.Sequential(
            nn.Conv2d(config.hidden, config.head, 3, padding=1),
            nn.ReLU(),
            silent(nn.Conv2d(config.head, 1, 3, padding=1)),
        )
        self.update = Update(config)
        self.upsample = RaftUpsampler(config)

    @property
    def state_tensors(self) -> tuple[StateTensor, ...]:
        hidden = self.config.hidden
        return (
            StateTensor("disparity", 1, CELL_PX),
            StateTensor("hidden_0", hidden, CELL_PX),
            StateTensor("hidden_1", hidden, 2 * CELL_PX),
        )

    def carried(self, state: RaftState, uvd_curr_from_prev: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Disparity and hidden states in the new view, each with a mask of its known cells."""
        disparity, *hidden = state
        if self.config.warp:
            return splat_levels(disparity, tuple(hidden), uvd_curr_from_prev, scale=CELL_PX)
        known8 = (disparity > 0).to(disparity.dtype)
        known16 = F.max_pool2d(known8, 2)
        return [(disparity, known8), (hidden[0], known8), (hidden[1], known16)]

    def begin(
        self, left: Tensor, right: Tensor, uvd_curr_from_prev: Tensor, state: RaftState
    ) -> tuple[Tensor, RaftGiven, RaftState]:
        """The part before the iterations: first disparity, shared inputs, starting state."""
        encoding = self.encoder(left, right)
        given = RaftGiven(correlation(encoding.left, encoding.right), *encoding.gates)
        # Twice itself or half of it is one step of the same size.
        first = TYPICAL_PX * self.first(encoding.context).float().clamp(-5, 3).exp()
        carried = self.carried(state, uvd_curr_from_prev)
        moving = (
            start + seen * (values - start)
            for start, (values, seen) in zip((first, *encoding.hidden), carried, strict=True)
        )
        return first, given, RaftState(*moving)

    def iterate(self, given: RaftGiven, levels: list[Tensor], moving: RaftState) -> RaftState:
        """One iteration; ``levels`` is the pyramid of the given pairs."""
        d, *hidden = moving
        gates = (given.gates8, given.gates16)
        (hidden8, hidden16), d = self.update((hidden[0], hidden[1]), gates, d, levels)
        return RaftState(d, hidden8, hidden16)

    def end(self, moving: RaftState) -> tuple[Tensor, Tensor, RaftState]:
        """The part after the iterations: disparity and sigma at full size, and the next state."""
        d, hidden8, hidden16 = moving
        disparity, sigma = self.upsample(hidden8, d)
        following = RaftState(d.clamp(min=MIN_PX), hidden8, hidden16)
        return disparity.clamp(min=MIN_PX), sigma, following

    def forward(
        self,
        left: Tensor,
        right: Tensor,
        uvd_curr_from_prev: Tensor,
        state: State,
        iterations: int,
    ) -> tuple[RaftEstimate, RaftState]:
        first, given, moving = self.begin(left, right, uvd_curr_from_prev, RaftState(*state))
        levels = pyramid(given.pairs)
        eighths = []
        for _ in range(iterations):
            moving = self.iterate(given, levels, moving)
            eighths.append(moving.disparity)
        disparity, sigma, following = self.end(moving)
        return RaftEstimate(disparity, sigma, given.pairs, first, eighths), following
