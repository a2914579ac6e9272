"""Every waiter gets its own result or an exception, whatever else is in its batch."""

import asyncio
from collections.abc import Sequence
from operator import itemgetter

import numpy as np
import pytest
from prometheus_client import CollectorRegistry

from tests.support.frames import RIG, make_frame
from tests.support.models import NOT_FINITE, RAISES, RecallModel
from tests.support.polling import turns
from tests.support.server import ManualClock
from vergence_proto.errors import Draining, FrameStale, ModelFailed, NonFinite
from vergence_proto.geometry import RectifiedRig
from vergence_proto.types import Timings
from vergence_service.inference.batcher import StepBatcher
from vergence_service.inference.model import Step, StepResult, StereoView
from vergence_service.process.memory import MemoryBudget
from vergence_service.process.metrics import Metrics


def make_batcher(
    model: RecallModel,
    *,
    max_batch: int = 8,
    memory_bytes: int = 1 << 30,
    clock: ManualClock | None = None,
) -> StepBatcher:
    metrics = Metrics(CollectorRegistry())
    return StepBatcher(
        model,
        max_batch=max_batch,
        memory=MemoryBudget(memory_bytes, metrics=metrics),
        clock=clock or ManualClock(),
        metrics=metrics,
    )


def make_step(brightness: int, *, rig: RectifiedRig = RIG, iterations: int = 1) -> Step:
    frame = make_frame(1, brightness=brightness, rig=rig)
    return Step(StereoView(frame.left, frame.right, rig, frame.capture_ns), None, iterations)


async def all_in_the_model(
    batcher: StepBatcher, model: RecallModel, brightnesses: Sequence[int] = ()
) -> list[asyncio.Task[tuple[StepResult, Timings]]]:
    """Start as many steps as the model has lanes, and wait until the model has all of them."""
    steps = []
    for brightness in brightnesses or range(1, model.max_concurrent_steps + 1):
        steps.append(asyncio.create_task(batcher.step(make_step(brightness))))
        await asyncio.to_thread(model.wait_until_entered)
    return steps


async def gathered_behind_another(
    batcher: StepBatcher, model: RecallModel, steps: list[Step]
) -> list[tuple[StepResult, Timings] | BaseException]:
    """Let all ``steps`` wait together while another step is in the model."""
    with model.busy():
        first = asyncio.create_task(batcher.step(make_step(1)))
        await asyncio.to_thread(model.wait_until_entered)
        waiting = [asyncio.create_task(batcher.step(step)) for step in steps]
        await asyncio.sleep(0)  # each runs up to its wait
        model.batches.clear()
    await first
    return await asyncio.gather(*waiting, return_exceptions=True)


async def test_rows_of_one_batch_get_their_own_results() -> None:
    model = RecallModel()
    steps = [make_step(brightness) for brightness in (10, 90, 200)]
    async with make_batcher(model) as batcher:
        together = await gathered_behind_another(batcher, model, steps)
    assert model.batches == [3]
    for step, timed in zip(steps, together, strict=True):
        assert isinstance(timed, tuple)
        np.testing.assert_array_equal(timed[0].offset_px, model.step([step])[0].offset_px)


async def test_a_batch_holds_one_size_and_one_iteration_count() -> None:
    model = RecallModel()
    other_rig = RectifiedRig(32, 24, 30.0, 30.0, 15.5, 15.5, 11.5, 0.1)
    steps = [
        make_step(10),
        make_step(20, rig=other_rig),
        make_step(30),
        make_step(40, iterations=4),
        make_step(50, rig=other_rig),
    ]
    async with make_batcher(model) as batcher:
        results = await gathered_behind_another(batcher, model, steps)
    assert model.batches == [2, 2, 1]
    assert all(isinstance(result, tuple) for result in results)


async def test_a_batch_is_no_larger_than_allowed() -> None:
    model = RecallModel()
    async with make_batcher(model, max_batch=2) as batcher:
        await gathered_behind_another(batcher, model, [make_step(i) for i in range(5)])
    assert model.batches == [2, 2, 1]


async def test_a_bad_row_does_not_fail_its_neighbours() -> None:
    model = RecallModel()
    steps = [make_step(brightness) for brightness in (50, RAISES, 70)]
    async with make_batcher(model) as batcher:
        outcomes = await gathered_behind_another(batcher, model, steps)
    assert [type(outcome) for outcome in outcomes] == [tuple, ModelFailed, tuple]
    assert "secret" not in str(outcomes[1])


async def test_the_model_lives_on_after_a_failure() -> None:
    async with make_batcher(RecallModel()) as batcher:
        with pytest.raises(ModelFailed):
            await batcher.step(make_step(RAISES))
        assert isinstance(await batcher.step(make_step(1)), tuple)


async def test_a_step_past_its_deadline_is_not_taken() -> None:
    clock, model = ManualClock(), RecallModel()
    async with make_batcher(model, clock=clock) as batcher:
        with model.busy():
            first = asyncio.create_task(batcher.step(make_step(1)))
            await asyncio.to_thread(model.wait_until_entered)
            late = asyncio.create_task(batcher.step(make_step(2), deadline_s=clock.now_s + 0.1))
            patient = asyncio.create_task(batcher.step(make_step(3), deadline_s=clock.now_s + 9))
            await asyncio.sleep(0)
            clock.advance(0.2)
        with pytest.raises(FrameStale, match=r"waited 0\.200 s"):
            await late
        assert (await patient)[1].queue_s == pytest.approx(0.2)
        await first
    assert model.batches == [1, 1]


async def test_a_caller_that_gives_up_does_not_stop_the_others() -> None:
    model = RecallModel()
    async with make_batcher(model) as batcher:
        with model.busy():
            impatient = asyncio.create_task(batcher.step(make_step(1)))
            await asyncio.to_thread(model.wait_until_entered)
            patient = asyncio.create_task(batcher.step(make_step(2)))
            await asyncio.sleep(0)
            impatient.cancel()
        assert isinstance(await patient, tuple)
    assert impatient.cancelled()


@pytest.mark.parametrize("lanes", [1, 2])
async def test_waiters_get_an_error_when_the_batcher_ends(lanes: int) -> None:
    model = RecallModel(max_concurrent_steps=lanes)
    with model.busy():
        async with make_batcher(model) as batcher:
            steps = [*await all_in_the_model(batcher, model)]
            steps.append(asyncio.create_task(batcher.step(make_step(99))))
            await asyncio.sleep(0)
            asyncio.get_running_loop().call_later(0.02, model.let_go)
    outcomes = await asyncio.gather(*steps, return_exceptions=True)
    assert [type(outcome) for outcome in outcomes] == [Draining] * (lanes + 1)


async def test_lanes_are_filled_as_steps_arrive_and_taken_by_one_step_each() -> None:
    clock, model = ManualClock(), RecallModel(max_concurrent_steps=2)
    async with make_batcher(model, max_batch=8, clock=clock) as batcher:
        with model.busy():
            steps = [*await all_in_the_model(batcher, model)]
            steps += [asyncio.create_task(batcher.step(make_step(i))) for i in range(50, 55)]
            await turns()  # a step that may start has started by now
            clock.advance(0.5)
        waited_s = [timings.queue_s for _, timings in await asyncio.gather(*steps)]
        assert waited_s == [0, 0, *[0.5] * 5], "a step waits until a lane is free"
        for step, brightness in zip(steps, [1, 2, *range(50, 55)], strict=True):
            expected = model.step([make_step(brightness)])[0].offset_px
            np.testing.assert_array_equal((await step)[0].offset_px, expected)
    assert set(model.batches) == {1}


class TickingClock(ManualClock):
    """A second passes whenever it is read, so that no two moments are the same."""

    def __call__(self) -> float:
        self.advance(1.0)
        return self.now_s


@pytest.mark.parametrize("lanes", [1, 2, 3])
async def test_no_stream_is_overtaken_by_another(lanes: int) -> None:
    clock = TickingClock()
    taken: list[tuple[float, float]] = []  # when a step arrived, and when the model took it

    async def keep_stepping(stream: int) -> None:
        for _ in range(20):
            since_s = clock.now_s + 1.0  # what the batcher is about to read
            _, timings = await batcher.step(make_step(stream), live_stream=str(stream))
            taken.append((since_s, since_s + timings.queue_s))

    async with make_batcher(
        RecallModel(max_concurrent_steps=lanes), max_batch=1, clock=clock
    ) as batcher:
        await asyncio.gather(*map(keep_stepping, range(5)))
    assert [since_s for since_s, _ in sorted(taken, key=itemgetter(1))] == sorted(dict(taken))


async def test_steps_that_are_not_live_are_shared_out_by_owner() -> None:
    done: list[str] = []

    async def keep_stepping(owner: str) -> None:
        while len(done) < 60:
            await batcher.step(make_step(2), owner=owner)
            done.append(owner)

    async with make_batcher(RecallModel(), max_batch=1, clock=TickingClock()) as batcher:
        await asyncio.gather(*(keep_stepping(owner) for owner in (*["ana"] * 9, "ben")))
    assert 25 <= done[:60].count("ben") <= 35


@pytest.mark.parametrize("bad", [RAISES, NOT_FINITE])
async def test_a_failure_in_one_lane_does_not_reach_the_other(bad: int) -> None:
    model = RecallModel(max_concurrent_steps=2)
    async with make_batcher(model) as batcher:
        with model.busy():
            steps = await all_in_the_model(batcher, model, brightnesses=(bad, 70))
        failed, fine = await asyncio.gather(*steps, return_exceptions=True)
        assert isinstance(failed, ModelFailed if bad == RAISES else NonFinite)
        assert isinstance(fine, tuple)
        model.batches.clear()
        with model.busy():  # both lanes are free again
            again = await all_in_the_model(batcher, model)
        await asyncio.gather(*again)
    assert model.batches == [1, 1]
