"""A tiny fake network: its memory, its failures and its pace are visible."""

import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from vergence_proto.errors import NonFinite
from vergence_proto.model_io import ModelCard, StateTensor
from vergence_service.inference.model import RecurrentState, Step, StepResult
from vergence_service.inference.onnx_model import on_host

# The value of a left image's first pixel that makes the model fail on it.
RAISES = 255
NOT_FINITE = 254
NO_MEMORY = 253


class RecallModel:
    """Offset = 4 + brightness / 64 + motion + half of the offset before: memory made visible."""

    provider = "numpy"
    engine = "recall 1"
    card = ModelCard(
        name="recall",
        stride=1,
        max_disparity_px=64,
        state=(StateTensor("memory", channels=1, scale=1),),
        graphs={1: ((Path("recall-1"),),), 4: ((Path("recall-4"),),)},
        weights_sha256="0" * 64,
    )

    def __init__(self, *, max_concurrent_steps: int = 1) -> None:
        self.max_concurrent_steps = max_concurrent_steps
        self.batches: list[int] = []
        self._free = threading.Event()
        self._free.set()
        self._entered = threading.Semaphore(0)

    def warm_up(self, iterations: int, *cold_iterations: int) -> None:
        assert {iterations, *cold_iterations} <= set(self.card.graphs)

    def step_bytes(self, height: int, width: int, iterations: int, *, cold: bool) -> int:
        return 64 * height * width

    def step(self, steps: Sequence[Step]) -> list[StepResult]:
        assert len({(row.iterations, row.cold, row.view.left.shape) for row in steps}) == 1
        self.batches.append(len(steps))
        self._entered.release()
        assert self._free.wait(timeout=30)
        for row in steps:
            if row.view.left[0, 0, 0] == RAISES:
                raise ArithmeticError("lens flare in /srv/secret.py")
            if row.view.left[0, 0, 0] == NO_MEMORY:
                raise MemoryError("a step of 64x48")
            if row.view.left[0, 0, 0] == NOT_FINITE:
                raise NonFinite(
                    "the network's result was not finite; the stream starts again without a state"
                )
        return [self._step_one(row) for row in steps]

    def _step_one(self, row: Step) -> StepResult:
        memory = on_host(row.state.tensors[0])[0] if row.state else np.float32(0)
        motion = row.uvd_curr_from_prev - np.eye(4, dtype=np.float32)
        brightness = row.view.left.mean(axis=2, dtype=np.float32) / 64
        offset_px = 4 + brightness + np.abs(motion).sum() + memory / 2
        state = RecurrentState.after(row.view, row.state, (offset_px[None],))
        return StepResult(offset_px, np.full_like(offset_px, 0.5), state)

    @contextmanager
    def busy(self) -> Iterator[None]:
        """Until the block ends, every step that enters the model stays in it."""
        self._free.clear()
        try:
            yield
        finally:
            self._free.set()

    def let_go(self) -> None:
        """Let the steps that are in the model end, before its block does."""
        self._free.set()

    def wait_until_entered(self) -> None:
        """Block until one more step than before has reached the model."""
        assert self._entered.acquire(timeout=30)


class PacedModel(RecallModel):
    """A model whose steps take ``step_s``, so that tests can see the progress of a sequence."""

    def __init__(self, step_s: float) -> None:
        super().__init__()
        self._step_s = step_s

    def step(self, steps: Sequence[Step]) -> list[StepResult]:
        time.sleep(self._step_s)
        return super().step(steps)
