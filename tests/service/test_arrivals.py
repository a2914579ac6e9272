"""Live steps run first; other steps run in the gaps and do not delay the next live frame."""

import asyncio
from collections.abc import Sequence

from tests.service.test_batcher import make_batcher, make_step
from tests.support.frames import frame_message, make_frame
from tests.support.models import RecallModel
from tests.support.polling import PATIENCE_S, turns
from tests.support.server import ManualClock, raw_stream, running_server
from vergence_proto.v1 import depth_pb2 as pb
from vergence_service.inference.arrivals import ArrivalPredictor, ExpectedFrame
from vergence_service.inference.batcher import StepBatcher
from vergence_service.inference.model import Step, StepResult

STEP_S = 0.08
LIVE, OTHER = 200, 10  # brightness, by which the test distinguishes steps


class TimedModel(RecallModel):
    """A model whose steps all take STEP_S by the test's clock. It records their order."""

    def __init__(self, clock: ManualClock) -> None:
        super().__init__()
        self.stepped: list[int] = []
        self._clock = clock

    def step(self, steps: Sequence[Step]) -> list[StepResult]:
        self._clock.advance(STEP_S)
        self.stepped += [int(row.view.left[0, 0, 0]) for row in steps]
        return super().step(steps)


async def live(batcher: StepBatcher) -> None:
    await batcher.step(make_step(LIVE), live_stream="headset")


async def test_live_steps_overtake_those_that_wait() -> None:
    model = TimedModel(ManualClock())
    async with make_batcher(model) as batcher:
        with model.busy():
            others = [asyncio.create_task(batcher.step(make_step(OTHER))) for _ in range(3)]
            await asyncio.to_thread(model.wait_until_entered)
            others.append(asyncio.create_task(batcher.step(make_step(OTHER + 1))))
            urgent = asyncio.create_task(live(batcher))
            await asyncio.sleep(0)
        await asyncio.gather(*others, urgent)
    assert model.stepped == [OTHER, OTHER, OTHER, LIVE, OTHER + 1]


async def test_a_step_that_would_be_in_the_way_of_a_live_frame_waits_for_it() -> None:
    clock = ManualClock()
    model = TimedModel(clock)
    async with make_batcher(model, clock=clock) as batcher:
        await batcher.step(make_step(OTHER))  # how long it takes is known from now on
        for _ in range(3):  # ten a second, busy for 0.08 s of each 0.1
            await live(batcher)
            clock.advance(0.1 - STEP_S)
        clock.advance(-0.01)
        other = asyncio.create_task(batcher.step(make_step(OTHER + 1)))
        await turns()  # the batcher sees it, alone in the queue
        clock.advance(0.01)
        await live(batcher)
        clock.advance(3.0)  # the live stream has ended
        await asyncio.wait_for(other, PATIENCE_S)
    assert model.stepped == [OTHER, LIVE, LIVE, LIVE, LIVE, OTHER + 1]


async def test_a_free_lane_is_not_for_others_while_a_live_step_is_in_the_model() -> None:
    clock, model = ManualClock(), RecallModel(max_concurrent_steps=2)
    async with make_batcher(model, clock=clock) as batcher:
        with model.busy():
            urgent = asyncio.create_task(live(batcher))
            await asyncio.to_thread(model.wait_until_entered)
            other = asyncio.create_task(batcher.step(make_step(OTHER)))
            await turns()  # a step that may start has started by now
            clock.advance(0.5)
        await asyncio.wait_for(asyncio.gather(urgent, other), PATIENCE_S)
    assert other.result()[1].queue_s == 0.5


async def test_a_live_step_takes_the_free_lane_beside_another() -> None:
    model = RecallModel(max_concurrent_steps=2)
    async with make_batcher(model) as batcher:
        with model.busy():
            other = asyncio.create_task(batcher.step(make_step(OTHER)))
            await asyncio.to_thread(model.wait_until_entered)
            urgent = asyncio.create_task(live(batcher))
            await asyncio.to_thread(model.wait_until_entered)
        await asyncio.gather(urgent, other)


async def test_a_closed_stream_is_waited_for_no_longer() -> None:
    clock = ManualClock()
    model = TimedModel(clock)
    async with make_batcher(model, clock=clock) as batcher:
        await batcher.step(make_step(OTHER))
        for _ in range(3):
            await live(batcher)
            clock.advance(0.1 - STEP_S)
        batcher.forget("headset")
        _, timings = await asyncio.wait_for(batcher.step(make_step(OTHER)), PATIENCE_S)
    assert timings.queue_s == 0


async def test_the_last_lane_is_kept_for_live_streams() -> None:
    clock, model = ManualClock(), RecallModel(max_concurrent_steps=2)
    async with make_batcher(model, clock=clock) as batcher:
        await live(batcher)
        await asyncio.to_thread(model.wait_until_entered)
        model.batches.clear()
        clock.advance(0.5)
        with model.busy():
            others = [asyncio.create_task(batcher.step(make_step(OTHER))) for _ in range(2)]
            await asyncio.to_thread(model.wait_until_entered)
            await turns()  # a step that may start has started by now
            assert model.batches == [1]
            urgent = asyncio.create_task(live(batcher))
            await asyncio.to_thread(model.wait_until_entered)
        await asyncio.wait_for(asyncio.gather(urgent, *others), PATIENCE_S)


async def test_a_step_that_fits_into_the_gap_is_taken_at_once() -> None:
    clock = ManualClock()
    async with make_batcher(TimedModel(clock), clock=clock) as batcher:
        await batcher.step(make_step(OTHER))
        for _ in range(3):
            await live(batcher)
            clock.advance(0.5 - STEP_S)
        await live(batcher)
        _, timings = await asyncio.wait_for(batcher.step(make_step(OTHER)), PATIENCE_S)
    assert timings.queue_s == 0


async def test_no_step_waits_for_ever() -> None:
    clock = ManualClock()
    model = TimedModel(clock)
    async with make_batcher(model, clock=clock) as batcher:
        await batcher.step(make_step(OTHER))
        await live(batcher)
        other = asyncio.create_task(batcher.step(make_step(OTHER + 1)))
        for _ in range(40):  # a live stream that leaves no gap
            await live(batcher)
            await asyncio.sleep(0)
            if other.done():
                break
        await other
    taken = model.stepped.index(OTHER + 1)
    assert 20 < taken < 35, "expected it after two seconds of live steps"


def test_a_cadence_is_learned_and_forgotten() -> None:
    predictor = ArrivalPredictor()
    predictor.arrived("a", 1.0)
    assert predictor.next_expected(1.0) is None
    predictor.arrived("a", 1.5)
    assert predictor.next_expected(1.5) == ExpectedFrame(2.0, 2.25)
    predictor.arrived("b", 1.5)
    predictor.arrived("b", 1.6)
    assert predictor.next_expected(1.6) == ExpectedFrame(1.6 + (1.6 - 1.5), 1.6 + 1.5 * (1.6 - 1.5))
    assert predictor.next_expected(1.9) == ExpectedFrame(2.0, 2.25), "b has stopped"
    assert predictor.next_expected(2.3) is None, "both have"
    predictor.answered("a", 2.4)
    assert predictor.next_expected(2.4) == ExpectedFrame(2.0, 2.65), (
        "a was kept waiting and could not send"
    )


async def test_a_stream_that_has_ended_is_forgotten() -> None:
    async with running_server(RecallModel()) as server:

        def predicted() -> float:
            [metric] = server.engine.metrics.streams_predicted.collect()
            return metric.samples[0].value

        for _ in range(3):
            async with raw_stream(server, every=False) as call:
                assert (await call.ask(frame_message(make_frame(1)))).HasField("disparity")
                assert predicted() == 1
                await call.send(pb.StreamDepthRequest(end=pb.End()))
                assert await call.receive() is None
            assert predicted() == 0
