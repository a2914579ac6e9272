"""The laws of a stream: order, memory, failure, and why a state is new."""

import asyncio
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.support.frames import FRAME_NS, RIG, make_frame
from tests.support.models import NOT_FINITE, RAISES, RecallModel
from tests.support.server import running_server
from vergence_proto.errors import (
    BadPose,
    BadShape,
    DepthError,
    FrameOutOfOrder,
    ModelFailed,
    NonFinite,
    UnknownStream,
)
from vergence_proto.geometry import Axes, Pose
from vergence_proto.types import Delivery, DisparityMap, Origin, PoseSample, StereoFrame, StereoRig
from vergence_service.process.threads import Cost
from vergence_service.streams.engine import DepthEngine
from vergence_service.streams.stream import StreamConfig

OPENING = StreamConfig(StereoRig.from_rectified(RIG))


async def step(engine: DepthEngine, stream_id: str, frame: StereoFrame) -> DisparityMap:
    answer = await engine.step(stream_id, lambda: frame, arrived_s=0.0, cost=Cost())
    return answer.disparity_map()


def turned(degrees: float, position_m: tuple[float, float, float] = (0, 0, 0)) -> Pose:
    half = np.radians(degrees) / 2
    return Pose.from_xyzw(np.array([0, np.sin(half), 0, np.cos(half)]), np.array(position_m))


async def test_streams_stepped_together_get_what_each_gets_alone() -> None:
    walks = {"dark": 10, "grey": 60, "light": 120}

    async def alone(stream_id: str) -> list[DisparityMap]:
        async with running_server(RecallModel()) as server:
            await server.engine.open(stream_id, OPENING)
            return [
                await step(server.engine, stream_id, make_frame(i, brightness=walks[stream_id]))
                for i in range(1, 6)
            ]

    model = RecallModel()
    async with running_server(model, model__max_batch=4) as server:
        for stream_id in walks:
            await server.engine.open(stream_id, OPENING)
        # Every frame of every stream waits at once; each stream takes its own in order.
        together = {stream_id: [] for stream_id in walks}  # type: dict[str, list[DisparityMap]]
        steps = [
            step(server.engine, stream_id, make_frame(i, brightness=walks[stream_id]))
            for i in range(1, 6)
            for stream_id in walks
        ]
        for index, result in enumerate(await asyncio.gather(*steps)):
            together[list(walks)[index % 3]].append(result)

    assert max(model.batches) > 1
    for stream_id in walks:
        for mine, shared in zip(await alone(stream_id), together[stream_id], strict=True):
            assert mine.frame_id == shared.frame_id
            np.testing.assert_array_equal(mine.disparity_px, shared.disparity_px)


async def test_a_failed_step_leaves_the_stream_as_it_was() -> None:
    async with running_server(RecallModel()) as server:
        for stream_id in ("spared", "hit"):
            await server.engine.open(stream_id, OPENING)
            await step(server.engine, stream_id, make_frame(1))
        with pytest.raises(ModelFailed) as failure:
            await step(server.engine, "hit", make_frame(2, brightness=RAISES))

        assert "secret" not in str(failure.value)
        spared = await step(server.engine, "spared", make_frame(2))
        hit = await step(server.engine, "hit", make_frame(2))  # the same id: it was not taken
        np.testing.assert_array_equal(hit.disparity_px, spared.disparity_px)
        assert (hit.origin, hit.step_count, hit.frames_skipped) == (Origin.WARM, 2, 1)


async def test_a_result_that_is_not_finite_starts_the_stream_anew() -> None:
    async with running_server(RecallModel()) as server:
        await server.engine.open("a", OPENING)
        first = await step(server.engine, "a", make_frame(1))
        with pytest.raises(NonFinite):
            await step(server.engine, "a", make_frame(2, brightness=NOT_FINITE))
        after = await step(server.engine, "a", make_frame(3))

        assert (after.origin, after.step_count) == (Origin.RESET_NON_FINITE, 1)
        np.testing.assert_array_equal(after.disparity_px, first.disparity_px)


async def test_a_frame_that_is_not_newer_is_refused_and_changes_nothing() -> None:
    async with running_server(RecallModel()) as server:
        await server.engine.open("a", OPENING)
        await step(server.engine, "a", make_frame(5))
        for stale_id in (5, 4):
            with pytest.raises(FrameOutOfOrder, match="above 5"):
                await step(server.engine, "a", make_frame(stale_id))
        assert (await step(server.engine, "a", make_frame(6))).step_count == 2


def moved(frame: StereoFrame, pose: PoseSample | None) -> StereoFrame:
    return replace(frame, pose=pose)


@pytest.mark.parametrize(
    ("second", "expected"),
    [
        pytest.param(make_frame(2), Origin.WARM, id="next-frame"),
        pytest.param(moved(make_frame(2), None), Origin.RESET_POSE_LOST, id="no-pose"),
        pytest.param(
            moved(make_frame(2), PoseSample(Pose.identity(), orientation_valid=False)),
            Origin.RESET_POSE_LOST,
            id="orientation-lost",
        ),
        pytest.param(
            moved(make_frame(2), PoseSample(turned(0), position_valid=False)),
            Origin.WARM,
            id="position-lost",
        ),
        pytest.param(
            moved(make_frame(2), PoseSample(turned(0, (3.2, 0, 0)))),
            Origin.RESET_POSE_JUMP,
            id="teleport",
        ),
        pytest.param(
            moved(make_frame(2), PoseSample(turned(50))), Origin.RESET_POSE_JUMP, id="spin"
        ),
        pytest.param(
            replace(make_frame(2), capture_ns=FRAME_NS + 16_000_000_000), Origin.RESET_GAP, id="gap"
        ),
        pytest.param(
            replace(make_frame(2), capture_ns=FRAME_NS - 1),
            Origin.RESET_TIME_BACKWARDS,
            id="time-backwards",
        ),
    ],
)
async def test_the_answer_says_why_a_state_is_new(second: StereoFrame, expected: Origin) -> None:
    async with running_server(RecallModel()) as server:
        await server.engine.open("a", OPENING)
        cold = await step(server.engine, "a", make_frame(1))
        answer = await step(server.engine, "a", second)

        assert (cold.origin, cold.iterations) == (Origin.COLD_START, 4)
        assert answer.origin is expected
        assert answer.step_count == (2 if expected is Origin.WARM else 1)
        assert answer.iterations == (1 if expected is Origin.WARM else 4)


async def test_where_only_the_orientation_is_tracked_the_warp_is_a_rotation() -> None:
    async def second_map(pose: PoseSample) -> DisparityMap:
        async with running_server(RecallModel()) as server:
            await server.engine.open("a", OPENING)
            await step(server.engine, "a", moved(make_frame(1), PoseSample(turned(0))))
            return await step(server.engine, "a", moved(make_frame(2), pose))

    lost = await second_map(PoseSample(turned(5, (0.5, 0, 0)), position_valid=False))
    turned_only = await second_map(PoseSample(turned(5)))
    moved_too = await second_map(PoseSample(turned(5, (0.5, 0, 0))))
    np.testing.assert_array_equal(lost.disparity_px, turned_only.disparity_px)
    assert not np.array_equal(lost.disparity_px, moved_too.disparity_px)


@pytest.mark.parametrize("axes", list(Axes), ids=lambda axes: axes.name)
async def test_poses_come_in_and_go_out_in_the_axes_of_the_stream(axes: Axes) -> None:
    def frames(convert: Callable[[Pose], Pose]) -> list[StereoFrame]:
        poses = [turned(0), turned(3, (0.05, -0.02, 0.1))]
        return [moved(make_frame(i + 1), PoseSample(convert(pose))) for i, pose in enumerate(poses)]

    async with running_server(RecallModel()) as server:
        await server.engine.open("opencv", OPENING)
        await server.engine.open("theirs", replace(OPENING, axes=axes))
        for plain, theirs in zip(frames(lambda pose: pose), frames(axes.from_opencv), strict=True):
            expected = await step(server.engine, "opencv", plain)
            answer = await step(server.engine, "theirs", theirs)
            assert theirs.pose is not None
            assert answer.world_from_left is not None
            # Two changes of basis and back, in float64; the warp is float32.
            np.testing.assert_allclose(answer.disparity_px, expected.disparity_px, rtol=1e-5)
            np.testing.assert_allclose(
                answer.world_from_left.matrix, theirs.pose.world_from_left.matrix, atol=1e-12
            )


async def test_a_reset_takes_effect_at_the_next_frame_and_is_reported() -> None:
    async with running_server(RecallModel()) as server:
        await server.engine.open("a", OPENING)
        await step(server.engine, "a", make_frame(1))
        await server.engine.reset("a")
        answer = await step(server.engine, "a", make_frame(2))
        assert (answer.origin, answer.step_count) == (Origin.RESET_REQUESTED, 1)


async def test_a_caller_that_gives_up_leaves_the_stream_as_it_was() -> None:
    model = RecallModel()
    async with running_server(model) as server:
        await server.engine.open("a", OPENING)
        with model.busy():
            impatient = asyncio.create_task(step(server.engine, "a", make_frame(1)))
            await asyncio.to_thread(model.wait_until_entered)
            impatient.cancel()
            await asyncio.wait([impatient])
        assert impatient.cancelled()
        assert (await step(server.engine, "a", make_frame(1))).origin is Origin.COLD_START


@pytest.mark.parametrize(
    "error", [BadPose("not a number"), BadShape("no frame id")], ids=lambda error: error.code
)
async def test_what_does_not_decode_is_refused_and_counted(error: DepthError) -> None:
    def decode() -> StereoFrame:
        raise error

    async with running_server(RecallModel()) as server:
        stream = await server.engine.open("a", OPENING)
        with pytest.raises(type(error)):
            await server.engine.step("a", decode, arrived_s=0.0, cost=Cost())
        assert (stream.frames_failed, stream.state, stream.last_frame_id) == (1, None, 0)


async def test_a_frame_of_another_size_is_refused() -> None:
    async with running_server(RecallModel()) as server:
        await server.engine.open("a", OPENING)
        small = make_frame(1, rig=replace(RIG, width=32))
        with pytest.raises(BadShape, match="size the stream was opened with, got 32x48"):
            await step(server.engine, "a", small)


async def test_a_closed_stream_is_unknown() -> None:
    async with running_server(RecallModel()) as server:
        await server.engine.open("a", OPENING)
        await server.engine.close("a")
        with pytest.raises(UnknownStream, match="open it before"):
            await step(server.engine, "a", make_frame(1))


async def test_disparity_is_stated_relative_to_the_principal_points() -> None:
    shifted = replace(RIG, cx_left=RIG.cx_right + 4.25)
    async with running_server(RecallModel()) as server:
        await server.engine.open("plain", OPENING)
        await server.engine.open("shifted", StreamConfig(StereoRig.from_rectified(shifted)))
        plain = await step(server.engine, "plain", make_frame(1))
        answer = await step(server.engine, "shifted", make_frame(1))
        offset_px = plain.disparity_px  # with equal principal points they are the same
        # The right image was moved by the whole pixels: the model's search starts at 0.25 px.
        expected = offset_px - np.float32(0.25)
        assert (expected > 0).all()
        np.testing.assert_array_equal(answer.disparity_px, expected)


@pytest.mark.parametrize(
    ("delivery", "asked", "cold"),
    [(Delivery.NEWEST, 0, 1), (Delivery.EVERY, 0, 4), (Delivery.NEWEST, 4, 4)],
)
async def test_who_waits_for_every_frame_gets_a_first_one_with_more_iterations(
    delivery: Delivery, asked: int, cold: int
) -> None:
    opening = StreamConfig(StereoRig.from_rectified(RIG), delivery=delivery, cold_iterations=asked)
    async with running_server(RecallModel(), model__cold_iterations=3) as server:
        await server.engine.open("a", opening)
        answers = [await step(server.engine, "a", make_frame(i)) for i in (1, 2)]
    assert [answer.iterations for answer in answers] == [cold, 1]
