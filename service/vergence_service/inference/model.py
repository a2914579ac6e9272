"""One step of the recurrence: from a rectified pair and a state to disparity and the next state.

A state is a value. A step returns the next state and changes nothing, so the old state can be
stepped again. A sequence of disparity maps is a pure function of its frames.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vergence_proto.geometry import Pose, RectifiedRig, uvd_curr_from_prev
from vergence_proto.model_io import ModelCard
from vergence_proto.types import Image, Plane
from vergence_service.inference.tensors import Tensor

_NO_MOTION = np.eye(4, dtype=np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class StereoView:
    """The input of one step: a rectified pair and the pose of its left camera."""

    left: Image
    right: Image  # same shape as left
    rig: RectifiedRig
    capture_ns: int
    world_from_left: Pose | None = None  # pose of the rectified camera, OpenCV axes; None: unknown
    position_known: bool = True  # False: only the rotation of world_from_left can be trusted


@dataclass(frozen=True, slots=True, eq=False)
class RecurrentState:
    """The value that one step passes to the next: tensors and the view they belong to."""

    # In the order of the model card: [C, h, w] on the host, or [1, C, h, w] on a device.
    tensors: tuple[Tensor, ...]
    rig: RectifiedRig
    capture_ns: int
    world_from_left: Pose | None
    position_known: bool
    step_count: int  # steps since the last cold start

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
    """One row of a batch. It has a state only if both the state and the view have a pose."""

    view: StereoView
    state: RecurrentState | None  # None: a cold start
    iterations: int  # a count that the model card lists

    @property
    def cold(self) -> bool:
        return self.state is None

    @property
    def uvd_curr_from_prev(self) -> NDArray[np.float32]:
        """Return the motion of pixels and disparities that the camera's motion causes: [4, 4].

        It contains only the rotation if either position is unknown. It is the identity on a cold
        start.
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
    """The output of one step."""

    offset_px: Plane  # u_left - u_right, finite
    sigma_px: Plane  # expected absolute error of offset_px, finite
    state: RecurrentState


class StereoModel(Protocol):
    """A network that takes steps."""

    @property
    def card(self) -> ModelCard: ...

    @property
    def provider(self) -> str:
        """The hardware or execution provider, as clients see it."""
        ...

    @property
    def engine(self) -> str:
        """The library that runs the network, with its version."""
        ...

    @property
    def max_concurrent_steps(self) -> int:
        """The number of threads that may call ``step`` at once; above 1, batches gain nothing."""
        ...

    def warm_up(self, iterations: int, *cold_iterations: int) -> None:
        """Load whatever the first steps with these iteration counts would wait for."""
        ...

    def step_bytes(self, height: int, width: int, iterations: int, *, cold: bool) -> int:
        """Return the memory that one step of this image size takes at most while it runs."""
        ...

    def step(self, steps: Sequence[Step]) -> list[StepResult]:
        """Run one step of each stream.

        All steps have one image size and one iteration count, and either all or none are cold.

        Raises NonFinite if the result of any row is not finite, and MemoryError.
        """
        ...


def state_bytes(card: ModelCard, height: int, width: int) -> int:
    """Return the memory that the state of one stream needs."""
    height, width = card.step_size(height, width)
    return sum(4 * int(np.prod(tensor.shape(height, width))) for tensor in card.state)
