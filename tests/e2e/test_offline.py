"""The law of the whole path: a stream gives what the model gives if it is stepped by hand."""

import asyncio

import numpy as np
import pytest

from tests.support.server import running_server
from tests.support.textured_wall import write_wall
from vergence import (
    Delivery,
    DepthClient,
    DepthResult,
    ImageEncoding,
    OutputFormat,
    PlaneEncoding,
)
from vergence_proto.datasets import StereoSource, open_source
from vergence_proto.types import Plane
from vergence_service.inference.model import RecurrentState, Step, StereoView
from vergence_service.inference.onnx_model import OnnxStereoModel, packaged_weights_dir

COLD, WARM = 4, 1


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> StereoSource:
    directory = write_wall(tmp_path_factory.mktemp("wall") / "wall", frames=6)
    return open_source(f"vergence:{directory}")


@pytest.fixture(scope="module")
def model() -> OnnxStereoModel:
    return OnnxStereoModel(
        packaged_weights_dir(), "lite", providers=["cpu"], threads=2, allow_spinning=False
    )


def stepped_by_hand(model: OnnxStereoModel, source: StereoSource) -> list[Plane]:
    rig = source.rig.as_rectified()
    assert rig is not None
    state: RecurrentState | None = None
    offsets_px = []
    for each in source:
        frame = each.frame
        assert frame.pose is not None
        view = StereoView(
            frame.left, frame.right, rig, frame.capture_ns, frame.pose.world_from_left
        )
        [result] = model.step([Step(view, state, COLD if state is None else WARM)])
        offsets_px.append(result.offset_px)
        state = result.state
    return offsets_px


async def streamed(
    client: DepthClient,
    source: StereoSource,
    *,
    output: OutputFormat | None = None,
    encoding: ImageEncoding = ImageEncoding.RAW,
) -> list[DepthResult]:
    async with client.open_session(
        source.rig,
        delivery=Delivery.EVERY,
        output=output,
        encoding=encoding,
        iterations=WARM,
        cold_iterations=COLD,
    ) as session:
        return [
            await session.step(each.frame.left, each.frame.right, each.frame.pose)
            for each in source
        ]


@pytest.mark.parametrize("encoding", [ImageEncoding.RAW, ImageEncoding.PNG])
async def test_streamed_equals_offline_bit_for_bit(
    model: OnnxStereoModel, source: StereoSource, encoding: ImageEncoding
) -> None:
    output = OutputFormat(encoding=PlaneEncoding.FLOAT32)
    async with running_server(model) as server, DepthClient(server.grpc_address) as client:
        results = await streamed(client, source, output=output, encoding=encoding)
    for result, offset_px in zip(results, stepped_by_hand(model, source), strict=True):
        # The wire says NaN where a disparity is not positive.
        np.testing.assert_array_equal(result.offset_px[result.valid], offset_px[result.valid])
        assert (offset_px[~result.valid] <= 0).all()


async def test_two_clients_at_once_get_what_each_gets_alone(
    model: OnnxStereoModel, source: StereoSource
) -> None:
    async with running_server(model) as server, DepthClient(server.grpc_address) as client:
        alone = await streamed(client, source)
        together = await asyncio.gather(*(streamed(client, source) for _ in range(2)))
    for results in together:
        for result, same in zip(results, alone, strict=True):
            np.testing.assert_array_equal(result.disparity_px, same.disparity_px)


async def test_the_default_output_is_exact_to_a_128th_of_a_pixel(
    model: OnnxStereoModel, source: StereoSource
) -> None:
    async with running_server(model) as server, DepthClient(server.grpc_address) as client:
        results = await streamed(client, source)
    for result, offset_px in zip(results, stepped_by_hand(model, source), strict=True):
        assert result.valid.mean() > 0.5
        error = np.abs(result.offset_px - offset_px)[result.valid & (offset_px > 1 / 64)]
        assert error.max() <= 0.5 / 64
