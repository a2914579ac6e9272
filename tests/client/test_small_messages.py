"""Live sessions with a server elsewhere send and receive little; all others are exact."""

from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from typing import Any

import numpy as np
import pytest

from tests.support.frames import RIG, make_frame
from tests.support.models import RecallModel
from tests.support.polling import eventually
from tests.support.server import running_server
from vergence import (
    BadImage,
    BadPose,
    Delivery,
    DepthClient,
    DepthResult,
    ImageEncoding,
    NotSent,
    OutputFormat,
    PlaneEncoding,
    Pose,
)
from vergence.link_control import UPLOADS
from vergence_proto.types import StereoFrame
from vergence_service.inference.model import Step, StepResult


class SeeingModel(RecallModel):
    """Remembers the left image that it was given last."""

    left: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]

    def step(self, steps: Sequence[Step]) -> list[StepResult]:
        self.left = steps[0].view.left.copy()
        return super().step(steps)


@asynccontextmanager
async def elsewhere(model: RecallModel) -> AsyncIterator[DepthClient]:
    """A client that takes the address of its server for that of another machine."""
    async with running_server(model) as server:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("vergence.client.on_this_machine", lambda _: False)
            client = DepthClient(server.grpc_address)
        async with client:
            yield client


async def result_of(client: DepthClient, frame: StereoFrame, **choices: Any) -> DepthResult:
    async with client.open_session(RIG, **choices) as session:
        if choices.get("delivery") is Delivery.EVERY:
            return await session.step(frame.left, frame.right, frame.pose)
        assert session.submit(frame.left, frame.right, frame.pose)
        return await anext(session)


async def test_a_live_session_elsewhere_sends_grey_jpeg_and_receives_every_second_pixel() -> None:
    model, frame = SeeingModel(), make_frame(1)
    async with elsewhere(model) as client:
        result = await result_of(client, frame)
    assert (model.left[..., 0] == model.left[..., 1]).all()
    assert model.left.shape == frame.left.shape
    assert result.raw is not None
    assert (result.raw.step, result.raw.disparity_px.shape) == (2, (24, 32))
    assert result.disparity_px.shape == result.depth_m.shape == (48, 64)
    np.testing.assert_array_equal(result.disparity_px[::2, ::2], result.raw.disparity_px)
    np.testing.assert_array_equal(result.raw.disparity_px * 16 % 1, 0)


async def test_what_a_live_session_asks_for_is_what_it_gets() -> None:
    model, frame = SeeingModel(), make_frame(1)
    async with elsewhere(model) as client:
        exact = await result_of(
            client,
            frame,
            encoding=ImageEncoding.RAW,
            output=OutputFormat(encoding=PlaneEncoding.FLOAT32),
        )
        np.testing.assert_array_equal(model.left, frame.left)
        assert exact.raw is not None
        assert exact.raw.step == 1
        small = await result_of(client, frame, output=OutputFormat(sigma=True, map_step=4))
    assert small.raw is not None
    assert small.raw.sigma_px is not None
    assert small.raw.sigma_px.shape == (12, 16)
    assert small.sigma_px is not None
    assert small.sigma_px.shape == (48, 64)


@pytest.mark.parametrize("delivery", Delivery, ids=lambda delivery: delivery.value)
async def test_sessions_on_this_machine_and_lossless_ones_are_exact(delivery: Delivery) -> None:
    model, frame = SeeingModel(), make_frame(1)
    async with running_server(model) as server, DepthClient(server.grpc_address) as client:
        here = await result_of(client, frame, delivery=delivery)
        np.testing.assert_array_equal(model.left, frame.left)
    async with elsewhere(model) as client:
        there = await result_of(client, frame, delivery=Delivery.EVERY)
        np.testing.assert_array_equal(model.left, frame.left)
    for result in (here, there):
        assert result.raw is not None
        assert result.raw.step == 1
    np.testing.assert_array_equal(here.disparity_px, there.disparity_px)


async def test_the_images_are_copied_and_mistakes_are_reported_before_a_thread_encodes_them() -> (
    None
):
    model, frame = SeeingModel(), make_frame(1)
    left, right = frame.left.copy(), frame.right.copy()
    async with elsewhere(model) as client, client.open_session(RIG) as session:
        with pytest.raises(BadImage, match="uint8"):
            session.submit(left.astype(np.float32), right)
        with pytest.raises(BadPose):
            session.submit(left, right, Pose(np.eye(3), np.full(3, np.nan)))
        assert session.submit(left, right, frame.pose) == 1
        left[:] = right[:] = 0
        await anext(session)
    assert model.left.mean() > 10


async def test_a_session_elsewhere_adapts_and_says_what_it_chose() -> None:
    async with elsewhere(RecallModel()) as client:
        frame = make_frame(1)
        async with client.open_session(RIG) as session:
            assert session.link.adapts
            assert session.link.up_mbit_s is None
            assert session.credit > 2
            for _ in range(4):
                await eventually(lambda: session.submit(frame.left, frame.right, frame.pose))
                await anext(session)
            link = session.link
        async with client.open_session(RIG, jpeg_quality=33, link="fixed") as fixed:
            assert (fixed.link.adapts, fixed.link.jpeg_quality, fixed.credit) == (False, 33, 2)
    assert link.up_mbit_s is not None
    assert link.server_s is not None
    assert link.path_round_trip_s is not None
    assert (link.jpeg_quality, link.scale) in {(each.jpeg_quality, each.scale) for each in UPLOADS}


async def test_before_a_link_is_known_two_frames_are_sent() -> None:
    model, frame = RecallModel(), make_frame(1)
    async with elsewhere(model) as client, client.open_session(RIG) as session:
        with model.busy():
            sent = [session.submit(frame.left, frame.right, frame.pose) for _ in range(4)]
        assert sent == [1, 2, NotSent.CREDIT, NotSent.CREDIT]
        assert session.drops.at_source == 2


async def test_what_a_caller_fixes_is_not_adapted() -> None:
    frame = make_frame(1)
    async with elsewhere(RecallModel()) as client:
        output = OutputFormat(map_step=1)
        async with client.open_session(RIG, jpeg_quality=95, output=output) as session:
            for _ in range(6):
                await eventually(lambda: session.submit(frame.left, frame.right, frame.pose))
                result = await anext(session)
            assert result.raw is not None
            assert (session.link.jpeg_quality, result.raw.step) == (95, 1)
        with pytest.raises(ValueError, match="'auto' or 'fixed'"):
            client.open_session(RIG, link="slow")  # type: ignore[arg-type]
