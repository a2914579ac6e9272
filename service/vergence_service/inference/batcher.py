"""Schedule the steps of all streams on the model: in batches, or one per lane.

A model on a GPU takes batches. A model on a CPU may have lanes instead: threads that each take one
frame whenever they are free. Batches would not help there: a frame usually arrives while another
stream's frame is already in the model, so two busy streams would hardly ever share a batch.
"""

import asyncio
import logging
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from typing import Self

from vergence_proto.errors import DepthError, Draining, FrameStale, ModelFailed
from vergence_proto.types import Timings
from vergence_service.inference.arrivals import ArrivalPredictor
from vergence_service.inference.model import Step, StepResult, StereoModel
from vergence_service.inference.shares import Shares
from vergence_service.process.failures import out_of_memory
from vergence_service.process.memory import MemoryBudget
from vergence_service.process.metrics import Metrics
from vergence_service.process.threads import Cost

log = logging.getLogger(__name__)

# A step that is not live waits for live steps at most this long. A job then continues, if slowly,
# beside streams that leave no gap, and one live frame in thirty is late because of it.
_PATIENCE_S = 2.0
# Clients choose the sizes of their images, so there is no end of shapes.
_SHAPES_REMEMBERED = 64


@dataclass(frozen=True, slots=True, eq=False)
class _Waiting:
    """A step that waits for the model."""

    step: Step
    since_s: float
    deadline_s: float | None
    live_stream: str | None
    owner: str
    timings: Timings
    answer: asyncio.Future[tuple[StepResult, Timings]]
    cost: Cost

    @property
    def shape_of_work(self) -> tuple[object, ...]:
        """Return a key; steps with equal keys can share a batch."""
        return self.live, self.step.view.left.shape, self.step.iterations, self.step.cold

    @property
    def live(self) -> bool:
        return self.live_stream is not None


class StepBatcher:
    """Collects the steps that wait for the model and runs them, oldest first.

    Live steps run first. Other steps run in the gaps, in separate batches: first those of the owner
    that has used the least. A non-live step that would delay a live frame (running or expected
    soon) waits, at most ``_PATIENCE_S``. Of several lanes, one is never taken by such steps while
    there are live streams.

    Steps run side by side only in the memory that ``memory`` has left.

    Every waiter gets a result or an exception: ModelFailed, NonFinite, FrameStale, or Draining if
    the batcher ends first. A caller must never have two steps of one stream waiting.
    """

    def __init__(
        self,
        model: StereoModel,
        *,
        max_batch: int,
        memory: MemoryBudget,
        clock: Callable[[], float],
        metrics: Metrics,
    ) -> None:
        lanes = model.max_concurrent_steps
        self._model = model
        self._lanes = lanes
        # In a batch the first row would wait for the last while another lane is free.
        self._max_batch = max_batch if lanes == 1 else 1
        self._memory = memory
        self._clock = clock
        self._metrics = metrics
        self._waiting: list[_Waiting] = []
        self._in_model: list[_Waiting] = []
        self._free_lanes = lanes
        self._changed = asyncio.Event()  # set when a step waits, or one has left the model
        self._running: set[asyncio.Task[None]] = set()
        self._arrivals = ArrivalPredictor()
        metrics.streams_predicted.set_function(lambda: len(self._arrivals))
        self._shares = Shares()
        self._work_s: dict[tuple[object, ...], float] = {}  # last duration per shape of work

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
        for item in _unanswered([*self._in_model, *self._waiting]):
            item.answer.set_exception(Draining("the server stopped before it took the frame"))

    async def warm_up(self, iterations: int, *cold_iterations: int) -> None:
        """Load the graphs of these steps. Steps whose graphs are loaded run meanwhile."""
        await asyncio.to_thread(self._model.warm_up, iterations, *cold_iterations)

    async def step(
        self,
        step: Step,
        *,
        timings: Timings | None = None,
        deadline_s: float | None = None,
        live_stream: str | None = None,
        owner: str = "",
        cost: Cost | None = None,
    ) -> tuple[StepResult, Timings]:
        """Run one step; return its result, and ``timings`` extended by the wait and the model.

        ``live_stream`` is the id of the step's live stream, or None if the step is not live; such
        steps are shared out by ``owner``. What the step takes of the processor, or of the device,
        is added to ``cost``.

        Raises FrameStale if the model was not free before ``deadline_s``, ModelFailed or NonFinite
        if the model failed, and Draining if the batcher ends first.
        """
        now_s = self._clock()
        answer: asyncio.Future[tuple[StepResult, Timings]]
        answer = asyncio.get_running_loop().create_future()
        item = _Waiting(
            step,
            now_s,
            deadline_s,
            live_stream,
            owner,
            timings or Timings(),
            answer,
            cost or Cost(),
        )
        if live_stream is not None:
            self._arrivals.arrived(live_stream, now_s)
        else:
            here = [*self._waiting, *self._in_model]
            self._shares.enter(owner, [each.owner for each in here if not each.live])
        self._waiting.append(item)
        if self._max_batch == 1:
            self._start_ready()  # a batch of one waits for no neighbour
        if self._waiting:
            self._changed.set()
        return await answer

    def forget(self, stream_id: str) -> None:
        """Forget what was learned about a live stream, because it is closed."""
        self._arrivals.forget(stream_id)

    async def _run(self) -> None:
        try:
            while True:
                hold_s = self._start_ready()
                self._changed.clear()
                with suppress(TimeoutError):
                    await asyncio.wait_for(self._changed.wait(), hold_s)
        finally:
            for lane in self._running:
                lane.cancel()
            await asyncio.gather(*self._running, return_exceptions=True)

    async def _in_lane(self, batch: list[_Waiting], memory: ExitStack) -> None:
        with memory:
            await self._step_together(batch)
        # Not reached when cancelled: __aexit__ then answers the steps that have no answer.
        self._in_model = [item for item in self._in_model if item not in batch]
        self._free_lanes += 1
        if self._waiting:
            self._changed.set()

    def _start_ready(self) -> float | None:
        """Start the work that may start now.

        Returns the seconds until waiting work may start; None: it waits for another step.
        """
        while self._free_lanes:
            batch = self._oldest()
            hold_s = self._hold_s(batch[0]) if batch else None
            if hold_s == 0 and not self._memory.may_step(self._bytes_of(batch)):
                hold_s = None  # until another step has ended
            if hold_s != 0:
                return hold_s
            self._waiting = [item for item in self._waiting if item not in batch]
            self._in_model += batch
            self._free_lanes -= 1
            memory = ExitStack()  # counted from now on: the next batch must not get it too
            memory.enter_context(self._memory.stepping(self._bytes_of(batch)))
            lane = asyncio.create_task(self._in_lane(batch, memory))
            self._running.add(lane)
            lane.add_done_callback(self._running.discard)
        return None

    def _bytes_of(self, batch: Sequence[_Waiting]) -> int:
        step = batch[0].step
        height, width = step.view.left.shape[:2]
        return len(batch) * self._model.step_bytes(height, width, step.iterations, cold=step.cold)

    def _hold_s(self, first: _Waiting) -> float:
        """Return the time that ``first`` must wait so that it delays no live frame."""
        now_s = self._clock()
        patience_s = _PATIENCE_S - (now_s - first.since_s)
        if first.live:
            return 0.0
        others = sum(not item.live for item in self._in_model)
        if len(self._arrivals) and others >= max(self._lanes - 1, 1):
            return _PATIENCE_S  # the last lane is for the next live frame
        if patience_s <= 0:
            return 0.0
        if any(item.live for item in self._in_model):
            return patience_s
        if (expected := self._arrivals.next_expected(now_s)) is None:
            return 0.0
        # Assume that work of an unknown shape takes as long as the longest work so far.
        longest_s = max(self._work_s.values(), default=0.0)
        ends_s = now_s + self._work_s.get(first.shape_of_work, longest_s)
        return expected.until_s - now_s if ends_s > expected.at_s else 0.0

    def _oldest(self) -> list[_Waiting]:
        """Return the steps to run next: live before others, then oldest first, up to one batch."""
        now_s = self._clock()
        unanswered = _unanswered(self._waiting)
        for item in unanswered:
            if item.deadline_s is not None and now_s > item.deadline_s:
                item.answer.set_exception(
                    FrameStale(
                        f"the frame waited {now_s - item.since_s:.3f} s for the model, longer than "
                        "its maximum age; the stream is unchanged"
                    )
                )
        # The sort is stable: oldest first.
        self._waiting = sorted(_unanswered(unanswered), key=self._order)
        work = self._waiting[0].shape_of_work if self._waiting else None
        return [item for item in self._waiting if item.shape_of_work == work][: self._max_batch]

    def _order(self, item: _Waiting) -> tuple[bool, float]:
        return not item.live, 0.0 if item.live else self._shares.used_s(item.owner)

    async def _step_together(self, batch: list[_Waiting]) -> None:
        started_s = self._clock()
        steps = [item.step for item in batch]
        loop = asyncio.get_running_loop()
        used = Cost()
        try:
            results = await loop.run_in_executor(self._threads, used.of, self._model.step, steps)
        except Exception as error:
            if len(batch) == 1:
                _fail(batch[0], error)
                return
            # One bad row must not fail its neighbours: find it by stepping each row alone.
            for item in _unanswered(batch):
                await self._step_together([item])
            return
        finally:
            # A device works while the thread waits, and a step may use the threads of other lanes.
            used_s = max(used.seconds, (self._clock() - started_s) / self._lanes)
            for item in batch:
                item.cost.seconds += used_s / len(batch)
                if not item.live:
                    self._shares.charge(item.owner, used_s / len(batch))
        model_s = self._clock() - started_s
        self._note_duration(batch[0].shape_of_work, model_s)
        self._metrics.batch_size.observe(len(batch))
        for item, result in zip(batch, results, strict=True):
            if item.live_stream is not None:
                self._arrivals.answered(item.live_stream, started_s + model_s)
            if not item.answer.done():
                queue_s = item.timings.queue_s + started_s - item.since_s
                timings = replace(item.timings, queue_s=queue_s, model_s=model_s)
                item.answer.set_result((result, timings))

    def _note_duration(self, shape_of_work: tuple[object, ...], model_s: float) -> None:
        self._work_s.pop(shape_of_work, None)  # the newest is last
        self._work_s[shape_of_work] = model_s
        if len(self._work_s) > _SHAPES_REMEMBERED:
            del self._work_s[next(iter(self._work_s))]


def _unanswered(items: Sequence[_Waiting]) -> list[_Waiting]:
    """Return the items that still need an answer; a caller that gave up has cancelled its own."""
    return [item for item in items if not item.answer.done()]


def _fail(item: _Waiting, error: Exception) -> None:
    if item.answer.done():
        return
    if isinstance(error, MemoryError):
        error = out_of_memory()
    elif not isinstance(error, DepthError):
        log.error("the model raised", exc_info=error)
        error = ModelFailed("the model failed on this frame; the stream is unchanged")
    item.answer.set_exception(error)
