"""The interface of every network: one step of the recurrence, from images and state to disparity.

The tiers differ in their computation and in their state, but all are called alike. So training,
validation, export and parity checks import this module alone.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeAlias, TypeVar

import torch
from torch import Tensor, nn

from vergence_models.config import NetworkConfig
from vergence_proto.model_io import StateTensor

# The recurrent state, float32 [B, C, H/s, W/s] each, as ``state_tensors`` describes them. All
# zeros is a cold start. A tier may name its tensors in a NamedTuple of its own.
State: TypeAlias = tuple[Tensor, ...]

ConfigT = TypeVar("ConfigT", bound=NetworkConfig, covariant=True)


@dataclass(frozen=True, slots=True, eq=False)
class Estimate(ABC):
    """The result of one step; a tier adds the inner estimates that its training supervises too."""

    disparity: Tensor  # float32 [B, H, W], px > 0
    sigma: Tensor  # float32 [B, H, W], px: the expected absolute error

    @abstractmethod
    def loss(self, truth_px: Tensor, max_disparity_px: int) -> Tensor:
        """The loss of this step against ``truth_px`` [B, H, W] (0 = unknown), a scalar."""


class StepOutput(NamedTuple):
    """The result of a step without inner estimates: the outputs of an exported graph."""

    disparity: Tensor  # float32 [B, H, W], px
    sigma: Tensor  # likewise
    state: State


class StereoNetwork(nn.Module, ABC, Generic[ConfigT]):
    """The whole step. ``iterations`` is an argument: the weights are the same for every count."""

    def __init__(self, config: ConfigT) -> None:
        super().__init__()
        self.config = config

    @property
    @abstractmethod
    def state_tensors(self) -> tuple[StateTensor, ...]:
        """The recurrent state as the contract names it, in the order of the state itself."""

    @abstractmethod
    def forward(
        self,
        left: Tensor,
        right: Tensor,
        uvd_curr_from_prev: Tensor,
        state: State,
        iterations: int,
    ) -> tuple[Estimate, State]:
        """One step. ``left`` and ``right`` uint8 [B, H, W, 3]; H and W multiples of the stride."""

    def cold_step(
        self, left: Tensor, right: Tensor, iterations: int, *, at_2x: int = 0
    ) -> StepOutput:
        """A step without a previous frame; the last ``at_2x`` iterations run at twice the size.

        Raises ValueError if ``at_2x`` is not 0 and the tier has no 2x refinement.
        """
        batch, height, width, _ = left.shape
        still = torch.eye(4, device=left.device).repeat(batch, 1, 1)
        nothing = self.cold_state(batch, height, width)
        estimate, state = self(left, right, still, nothing, iterations - at_2x)
        found = StepOutput(estimate.disparity, estimate.sigma, state)
        return self.refine_at_2x(left, right, found, at_2x) if at_2x else found

    def refine_at_2x(
        self, left: Tensor, right: Tensor, found: StepOutput, iterations: int
    ) -> StepOutput:
        """Refine the output of a step by more iterations on images of twice the size."""
        raise ValueError(f"{type(self).__name__} cannot refine at 2x, got {iterations} iterations")

    def cold_state(self, batch: int, height: int, width: int) -> State:
        """The state of a cold start, for images of that size, on the device of the weights."""
        device = next(self.parameters()).device
        return tuple(
            torch.zeros(batch, *tensor.shape(height, width), device=device)
            for tensor in self.state_tensors
        )


# Callers need no more than the fields that all configurations share.
AnyNetwork: TypeAlias = StereoNetwork[NetworkConfig]
