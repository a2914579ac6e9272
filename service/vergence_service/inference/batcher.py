"""The steps that wait for the model, taken across streams: together, or each in a lane of its own.

A model on a GPU takes batches. One on a CPU may have lanes instead: threads that step it one frame
each, whenever one of them is free. In a batch two busy streams would hardly ever meet, as each
frame arrives while the other stream's is in the model.
"""

import asyncio
import logging
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from typing import Self

from vergence_proto.errors import DepthError, Draining, FrameStale, ModelFailed
from vergence_service.inference.arrivals import ArrivalPredictor
from vergence_service.inference.model import Step, StepResult, StereoModel
from vergence_service.metrics import Metrics

log = logging.getLogger(__name__)

# A step that gives way to live ones does so for no longer: a batch goes on, if slowly, beside
# streams that leave no gap, and one live frame in thirty is late for it.
_PATIENCE_S = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class TimedResult:
    result: StepResult
    queue_s: float  # from the request to the start of the batch
    model_s: float  # of the whole batch


@dataclass(frozen=True, slots=True, eq=False)
class _Waiting:
    step: Step
    since_s: float
    deadline_s: float | None
    live_stream: str | None
    answer: asyncio.Future[TimedResult]

    @property
    def shape_of_work(self) -> tuple[object, ...]:
        """Rows can share a batch if this is equal."""
        return self.live, self.step.view.left.shape, self.step.iterations, self.step.cold

    @property
    def live(self) -> bool:
        return self.live_stream is not None


class StepBatcher:
    """Gathers the steps that wait for the model and runs them as it takes them, oldest first.

    Live steps come before all others, which fill the gaps that they leave, in batches of their
    own: one that would be in the way of a live frame, in the model or expected, is held back, but
    not for ever.
    Every waiter gets a result or an exception: ModelFailed, NonFinite, FrameStale, or Draining
    when the batcher ends first. A caller never has two steps of one stream waiting.
    """

    def __init__(
        self,
        model: StereoModel,
        *,
        max_batch: int,
        clock: Callable[[], float],
        metrics: Metrics,
    ) -> None:
        self._model = model
        # The first row of a batch would wait for the last while another lane stands empty.
        self._max_batch = max_batch if model.max_concurrent_steps == 1 else 1
        self._clock = clock
        self._metrics = metrics
        self._waiting: list[_Waiting] = []
        self._in_model: list[_Waiting] = []
        self._free_lanes = asyncio.Semaphore(model.max_concurrent_steps)
        self._changed = asyncio.Event()  # a step arrived, or left the model
        self._arrivals = ArrivalPredictor()
        self._work_s: dict[tuple[object, ...], float] = {}  # how long each shape of work took

    async def __aenter__(self) -> Self:
        self._threads = ThreadPoolExecutor(
            self._model.max_concurrent_steps, thread_name_prefix="model"
        )
        self._worker = asyncio.create_task(self._run(), name="step-batcher")
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        self._worker.cancel()
        await asyncio.gather(self._worker, return_exceptions=True)
        await asyncio.to_thread(self._threads.shutdown)
        for item in _wanted([*self._in_model, *self._waiting]):
            item.answer.set_exception(Draining("the server stopped before it took the frame"))

    async def warm_up(self, iterations: int, *cold_iterations: int) -> None:
        """Load the model, in a thread that will run it."""
        loop = asyncio.get_running_loop()
        await loop.run_in_executor(self._threads, self._model.warm_up, iterations, *cold_iterations)

    async def step(
        self, step: Step, *, deadline_s: float | None = None, live_stream: str | None = None
    ) -> TimedResult:
        """The result of one step; FrameStale if the model was not free before ``deadline_s``.

        ``live_stream`` is the stream that it is of, None for a step that gives way to live ones.
        """
        now_s = self._clock()
        answer: asyncio.Future[TimedResult] = asyncio.get_running_loop().create_future()
        self._waiting.append(_Waiting(step, now_s, deadline_s, live_stream, answer))
        if live_stream is not None:
            self._arrivals.arrived(live_stream, now_s)
        self._changed.set()
        return await answer

    async def _run(self) -> None:
        async with asyncio.TaskGroup() as lanes:
            while True:
                await self._free_lanes.acquire()
                batch = await self._next_batch()
                self._in_model += batch
                lanes.create_task(self._in_lane(batch))

    async def _in_lane(self, batch: list[_Waiting]) -> None:
        await self._step_together(batch)
        # Not where it is cancelled: those without an answer get one from __aexit__.
        self._in_model = [item for item in self._in_model if item not in batch]
        self._free_lanes.release()
        self._changed.set()

    async def _next_batch(self) -> list[_Waiting]:
        """What the model is to do next, as soon as it is time for it."""
        while True:
            batch = self._oldest()
            hold_s = self._hold_s(batch[0]) if batch else None
            if hold_s == 0:
                self._waiting = [item for item in self._waiting if item not in batch]
                return batch
            self._changed.clear()
            with suppress(TimeoutError):
                await asyncio.wait_for(self._changed.wait(), hold_s)

    def _hold_s(self, first: _Waiting) -> float:
        """How long the work of ``first`` is to stay out of the way of a live frame."""
        now_s = self._clock()
        patience_s = _PATIENCE_S - (now_s - first.since_s)
        if first.live or patience_s <= 0:
            return 0.0
        if any(item.live for item in self._in_model):
            return patience_s
        if (due := self._arrivals.next_expected(now_s)) is None:
            return 0.0
        # What was never seen is taken to be as long as the longest that was.
        longest_s = max(self._work_s.values(), default=0.0)
        ends_s = now_s + self._work_s.get(first.shape_of_work, longest_s)
        return due.until_s - now_s if ends_s > due.at_s else 0.0

    def _oldest(self) -> list[_Waiting]:
        """Of what waits: live or not, then oldest first, as much as the model takes together."""
        now_s = self._clock()
        wanted = _wanted(self._waiting)
        for item in wanted:
            if item.deadline_s is not None and now_s > item.deadline_s:
                item.answer.set_exception(
                    FrameStale(
                        f"the frame waited {now_s - item.since_s:.3f} s for the model, past its "
                        "maximum age; the stream is as it was"
                    )
                )
        # The sort is stable: oldest first.
        self._waiting = sorted(_wanted(wanted), key=lambda item: not item.live)
        work = self._waiting[0].shape_of_work if self._waiting else None
        return [item for item in self._waiting if item.shape_of_work == work][: self._max_batch]

    async def _step_together(self, batch: list[_Waiting]) -> None:
        started_s = self._clock()
        steps = [item.step for item in batch]
        loop = asyncio.get_running_loop()
        try:
            results = await loop.run_in_executor(self._threads, self._model.step, steps)
        except Exception as error:
            if len(batch) == 1:
                _fail(batch[0], error)
                return
            # One bad row must not fail its neighbours: find it by stepping each alone.
            for item in _wanted(batch):
                await self._step_together([item])
            return
        model_s = self._clock() - started_s
        self._work_s[batch[0].shape_of_work] = model_s
        self._metrics.batch_size.observe(len(batch))
        for item, result in zip(batch, results, strict=True):
            if item.live_stream is not None:
                self._arrivals.answered(item.live_stream, started_s + model_s)
            if not item.answer.done():
                queue_s = started_s - item.since_s
                item.answer.set_result(TimedResult(result, queue_s, model_s))


def _wanted(items: Sequence[_Waiting]) -> list[_Waiting]:
    """A caller that gave up leaves a finished future behind; setting it again would raise."""
    return [item for item in items if not item.answer.done()]


def _fail(item: _Waiting, error: Exception) -> None:
    if item.answer.done():
        return
    if not isinstance(error, DepthError):
        log.error("the model raised", exc_info=error)
        error = ModelFailed("the model failed on this frame; the stream is as it was before it")
    item.answer.set_exception(error)
