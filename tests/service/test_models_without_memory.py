"""A model without memory is served as every other one, and nothing claims that it remembers."""

import asyncio

import numpy as np
import pytest

from tests.support.frames import RIG, make_frame
from tests.support.http import as_kept, disparities, ended, http_to, submit
from tests.support.sequences import make_frames, sequence_files, zip_bytes
from tests.support.server import running_server
from tests.support.session_frames import EXACT, step
from tests.support.weights_copy import WEIGHTS
from vergence import Delivery, DepthClient, DepthResult, ModelInfo, Origin
from vergence.info_codec import model_info_from_proto
from vergence_proto.types import StereoRig
from vergence_proto.v1 import depth_pb2 as pb
from vergence_service.inference.model import Step, StereoView
from vergence_service.inference.onnx_model import OnnxStereoModel
from vergence_service.inference.snapshots import state_from_bytes, state_to_bytes
from vergence_service.streams.conversion import decoded_view
from vergence_service.streams.stream import StreamConfig


@pytest.fixture(scope="module")
def model() -> OnnxStereoModel:
    return make_model()


def make_model(states_on: str | None = None) -> OnnxStereoModel:
    return OnnxStereoModel(
        WEIGHTS,
        "matcher",
        providers=["cpu"],
        threads=1,
        allow_spinning=False,
        states_on=states_on,
    )


async def test_every_frame_is_a_cold_start_whatever_happens_to_the_stream(
    model: OnnxStereoModel,
) -> None:
    async with (
        running_server(model) as server,
        DepthClient(server.grpc_address) as client,
    ):
        async with client.open_session(RIG, stream_id="hall", output=EXACT) as session:
            assert session.model.recurrent is False
            results = [await step(session, 1), await step(session, 2)]
            session.reset()
            results.append(await step(session, 3))
            async with client.open_session(
                RIG, stream_id="hall", resume_token=session.resume_token, output=EXACT
            ) as resumed:
                results.append(await step(resumed, 4))
                stream = await client.stream_info("hall")
        info = await client.server_info()
    assert [(each.origin, each.step_count) for each in results] == [(Origin.COLD_START, 1)] * 4
    assert (stream.frames_stepped, stream.step_count, stream.state_bytes) == (4, 0, 0)
    assert info.model.recurrent is False
    for each in results:  # the views of make_frame differ by 4 px; left of that is no second view
        assert np.median(each.disparity_px[8:-8, 20:]) == 4


async def test_sessions_and_jobs_over_every_transport_agree(model: OnnxStereoModel) -> None:
    frames = make_frames(4)

    async def stepped(client: DepthClient) -> list[DepthResult]:
        async with client.open_session(RIG, delivery=Delivery.EVERY, output=EXACT) as session:
            return await asyncio.gather(
                *(
                    session.step(each.left, each.right, each.pose, capture_ns=each.capture_ns)
                    for each in frames
                )
            )

    async with running_server(model) as server:
        async with DepthClient(server.grpc_address) as client:
            over_grpc = await stepped(client)
        async with DepthClient(f"http://{server.http_address}") as client:
            over_http = await stepped(client)
        async with http_to(server) as web:
            job = await submit(web, zip_bytes(sequence_files(frames)))
            assert (await ended(web, job["id"]))["state"] == "done"
            of_the_job = await disparities(web, job["id"])
            assert job["warnings"] == []
            more = await submit(web, zip_bytes(sequence_files(frames)), quality="steady")
            assert [each["kind"] for each in more["warnings"]] == ["quality"]
    for mine, same, kept in zip(over_grpc, over_http, of_the_job, strict=True):
        np.testing.assert_array_equal(mine.disparity_px, same.disparity_px)
        np.testing.assert_array_equal(kept, as_kept(mine.disparity_px))


async def test_a_sequence_that_goes_on_after_a_crash_does_not_claim_a_state(
    model: OnnxStereoModel,
) -> None:
    config = StreamConfig(StereoRig.from_rectified(RIG))
    async with running_server(model) as server:
        async with server.engine.offline(config) as stream:
            first = decoded_view(lambda: make_frame(1), stream)
            before = await server.engine.step_view(stream, *first)
            whole = await server.engine.step_offline(stream, make_frame(2))
        kept = state_from_bytes(state_to_bytes(before.result.state))
        async with server.engine.offline(config, state=kept) as stream:
            after = await server.engine.step_offline(stream, make_frame(2))
    assert (after.origin, after.step_count) == (Origin.COLD_START, 1)
    np.testing.assert_array_equal(after.disparity_px, whole.disparity_px)


def test_rows_of_a_batch_are_what_each_gets_alone_on_any_device(model: OnnxStereoModel) -> None:
    views = []
    for i in (1, 2, 3):
        frame = make_frame(i, brightness=i)
        views.append(StereoView(frame.left, frame.right, RIG, i))
    on_device = make_model(states_on="cpu")
    together = on_device.step([Step(view, None, 1) for view in views])
    for view, shared in zip(views, together, strict=True):
        for alone in (model, on_device):
            [result] = alone.step([Step(view, None, 1)])
            np.testing.assert_array_equal(result.offset_px, shared.offset_px)
            assert result.state.tensors == ()


def test_a_server_from_before_models_without_memory_has_one_with_memory() -> None:
    assert model_info_from_proto(pb.ModelInfo(name="lite")).recurrent
    assert ModelInfo("lite", "", (1,), 192).recurrent
