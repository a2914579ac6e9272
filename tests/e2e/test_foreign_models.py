"""A network of others over every transport: the answers are those of the graph itself."""

import asyncio
from pathlib import Path

import numpy as np
import onnxruntime
import pytest

from tests.support.foreign_graphs import GRAPHS, HEIGHT, WIDTH, written
from tests.support.server import PATIENCE_S, running_server
from tests.support.session_frames import EXACT
from tests.support.zenoh_net import address_of, free_endpoint
from vergence import Delivery, DepthClient
from vergence_models.foreign.adding import add_model
from vergence_models.foreign.guess import Given
from vergence_models.foreign.textures import Scene, scene
from vergence_proto.geometry import RectifiedRig
from vergence_service.inference.onnx_model import OnnxStereoModel

RIG = RectifiedRig(WIDTH, HEIGHT, 200.0, 200.0, 127.5, 127.5, 47.5, 0.1)


def by_hand(path: Path, pair: Scene) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """What a user of HITNet's graph writes: one input of six channels in 0..1, a map in NHWC."""
    both = np.concatenate([pair.left, pair.right], axis=2).transpose(2, 0, 1)[None]
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    [found] = session.run(None, {"input": both.astype(np.float32) / 255})
    disparity: np.ndarray[tuple[int, ...], np.dtype[np.float32]] = found[0, ..., 0]
    return disparity


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(GRAPHS["hitnet"].make(), tmp_path_factory.mktemp("theirs") / "hitnet.onnx")


async def test_over_grpc_http_and_zenoh_the_map_is_that_of_the_graph_by_hand(path: Path) -> None:
    add_model({1: path}, path.parent, name="hitnet", given=Given(like="hitnet"))
    model = OnnxStereoModel(
        path.parent, "hitnet", providers=["cpu"], threads=1, allow_spinning=False
    )
    pair = scene(HEIGHT, WIDTH, 5, 25, seed=8)
    expected = by_hand(path, pair)
    endpoint = free_endpoint()
    async with running_server(
        model, zenoh__enabled=True, zenoh__listen=[endpoint], model__min_range_share=0
    ) as server:
        for address in (
            server.grpc_address,
            f"http://{server.http_address}",
            address_of(endpoint),
        ):
            async with (
                DepthClient(address) as client,
                client.open_session(RIG, delivery=Delivery.EVERY, output=EXACT) as session,
            ):
                assert not session.model.recurrent
                step = session.step(pair.left, pair.right, capture_ns=1)
                result = await asyncio.wait_for(step, PATIENCE_S)
            found = result.disparity_px
            seen = found > 0  # a disparity of zero is no depth
            np.testing.assert_array_equal(found[seen], expected[seen])
            assert (expected[~seen] == 0).all()
            assert seen.mean() > 0.9
