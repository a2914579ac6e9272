"""What models that OpenCV computes have in common: no weights, and a thread for every step."""

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence

import cv2

from vergence_proto.model_io import ModelCard, StateTensor
from vergence_service.inference.installed import PROVIDERS, usable_cores
from vergence_service.inference.model import Step, StepResult

MAX_DISPARITY_PX = 192


class OpenCvModel(ABC):
    """A classical method. Steps of a batch run one after the other."""

    def __init__(
        self,
        name: str,
        *,
        threads: int,
        stride: int,
        iterations: Sequence[int] = (1,),
        state: tuple[StateTensor, ...] = (),
    ) -> None:
        about = f"{name} {MAX_DISPARITY_PX} OpenCV {cv2.__version__}"
        graphs: Mapping[int, tuple[()]] = dict.fromkeys(iterations, ())
        self._card = ModelCard(
            name=name,
            stride=stride,
            max_disparity_px=MAX_DISPARITY_PX,
            state=state,
            graphs=graphs,
            weights_sha256=hashlib.sha256(about.encode()).hexdigest(),
        )
        self._threads = threads or usable_cores()

    @property
    def card(self) -> ModelCard:
        return self._card

    @property
    def provider(self) -> str:
        return PROVIDERS["cpu"]

    @property
    def engine(self) -> str:
        return f"OpenCV {cv2.__version__}"

    @property
    def max_concurrent_steps(self) -> int:
        return self._threads

    def warm_up(self, iterations: int, *cold_iterations: int) -> None:  # noqa: B027
        """There is nothing to load."""

    def close(self) -> None:  # noqa: B027
        """There is nothing to stop."""

    def step(self, steps: Sequence[Step]) -> list[StepResult]:
        return [self._step(step) for step in steps]

    @abstractmethod
    def step_bytes(self, height: int, width: int, iterations: int, *, cold: bool) -> int:
        """Return the memory that one step of this image size takes at most while it runs."""

    @abstractmethod
    def _step(self, step: Step) -> StepResult: ...
