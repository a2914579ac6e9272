"""One step of the recurrence: a rectified pair and a state, to disparity and the next state.

A state is a value. A step returns the next one and changes nothing, so whoever holds the old one
may step it again; a sequence is a pure function of its frames.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vergence_proto.geometry import Pose, RectifiedRig, uvd_curr_from_prev
from vergence_proto.model_io import (
    ModelCard,
)
from vergence_proto.types import Image, Plane
from vergence_service.inference.providers import Tensor

_NO_MOTION = np.eye(4, dtype=np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class StereoView:
    """What one step looks at: a rectified pair and where its left camera was."""

    left: Image
    right: Image  # same shape as left
    rig: RectifiedRig
    capture_ns: int
    world_from_left: Pose | None = None  # the rectified camera's, OpenCV axes; None: not known
    position_known: bool = True  # False: only the rotation of world_from_left can be trusted


@dataclass(frozen=True, slots=True, eq=False)
class RecurrentState:
    """What one step hands to the next: the network's tensors, and the view they belong to."""

    # In the order of the model card: [C, h, w], or [1, C, h, w] where it stayed on a device.
    tensors: tuple[Tensor, ...]
    rig: RectifiedRig
    capture_ns: int
    world_from_left: Pose | None
    position_known: bool
    step_count: int  # steps since the state was new

    @classmethod
    def after(
        cls, view: StereoView, previous: "RecurrentState | None", tensors: tuple[Tensor, ...]
    ) -> "RecurrentState":
        return cls(
            tensors=tensors,
            rig=view.rig,
            capture_ns=view.capture_ns,
            world_from_left=view.world_from_left,
            position_known=view.position_known,
            step_count=1 if previous is None else previous.step_count + 1,
        )

    @property
    def nbytes(self) -> int:
        return sum(tensor.nbytes for tensor in self.tensors)


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """One row of a batch. A state is only given where it and the view have a pose."""

    view: StereoView
    state: RecurrentState | None  # None: a cold start
    iterations: int  # one of the model card's

    @property
    def cold(self) -> bool:
        return self.state is None

    @property
    def uvd_curr_from_prev(self) -> NDArray[np.float32]:
        """How the camera's motion moves pixels and disparities: [4, 4].

        Rotation alone where either position is not known; the identity on a cold start.
        """
        if (
            self.state is None
            or self.state.world_from_left is None
            or self.view.world_from_left is None
        ):
            return _NO_MOTION
        curr_from_prev = self.view.world_from_left.inverse() @ self.state.world_from_left
        if not (self.view.position_known and self.state.position_known):
            curr_from_prev = Pose(curr_from_prev.rotation, np.zeros(3))
        return uvd_curr_from_prev(self.view.rig, curr_from_prev, self.state.rig)


@dataclass(frozen=True, slots=True, eq=False)
class StepResult:
    offset_px: Plane  # u_left - u_right, finite
    sigma_px: Plane  # its expected absolute error, finite
    state: RecurrentState


class StereoModel(Protocol):
    """A network that takes steps."""

    @property
    def card(self) -> ModelCard: ...

    @property
    def provider(self) -> str:
        """What it runs on, as told to clients."""
        ...

    @property
    def engine(self) -> str:
        """What computes it, with its version."""
        ...

    @property
    def max_concurrent_steps(self) -> int:
        """How many threads may call ``step`` at once; above 1, a batch of several gains nothing."""
        ...

    def warm_up(self, iterations: int, *cold_iterations: int) -> None:
        """Do now what the first steps of such counts would otherwise wait for."""
        ...

    def step(self, steps: Sequence[Step]) -> list[StepResult]:
        """One step of each stream, all of one image size and iteration count, all cold or none.

        Raises NonFinite if any row's result is not finite.
        """
        ...


def state_bytes(card: ModelCard, height: int, width: int) -> int:
    """The memory that one stream's state takes."""
    height, width = card.step_size(height, width)
    return sum(4 * int(np.prod(tensor.shape(height, width))) for tensor in card.state)
