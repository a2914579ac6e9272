"""Networks of others over every transport: the answers are those of the graphs themselves."""

import asyncio
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.support.by_hand import disparity_by_hand
from tests.support.foreign_graphs import DISPARITIES, GRAPHS, HEIGHT, WIDTH, written
from tests.support.server import PATIENCE_S, running_server
from tests.support.session_frames import EXACT
from tests.support.zenoh_net import address_of, free_endpoint
from vergence import Delivery, DepthClient
from vergence_models.foreign.adding import add_model, check_model
from vergence_models.foreign.guess import Given
from vergence_models.foreign.textures import Scene, scene
from vergence_proto.geometry import RectifiedRig
from vergence_service.inference.model import Step, StereoView
from vergence_service.inference.onnx_model import OnnxStereoModel

RIG = RectifiedRig(WIDTH, HEIGHT, 200.0, 200.0, 127.5, 127.5, 47.5, 0.1)
# Each starts a server of three transports; CI has time for all of them.
QUICK = "hitnet"


def epe(found_px: NDArray[np.float32], pair: Scene) -> float:
    return float(np.nanmean(np.abs(found_px - pair.truth_px)))


@pytest.mark.parametrize(
    "layout",
    [name if name == QUICK else pytest.param(name, marks=pytest.mark.slow) for name in GRAPHS],
)
async def test_over_grpc_http_and_zenoh_the_map_is_that_of_the_graph_by_hand(
    layout: str, tmp_path: Path
) -> None:
    path = written(GRAPHS[layout].make(), tmp_path / "theirs.of-others")
    given = Given(max_disparity_px=DISPARITIES)
    added = add_model({1: path}, tmp_path, name="theirs", given=given)
    assert check_model(tmp_path, "theirs").contract == added.contract
    model = OnnxStereoModel(tmp_path, "theirs", providers=["cpu"], threads=1, allow_spinning=False)
    pair = scene(HEIGHT, WIDTH, 5, 25, seed=8)
    [direct] = model.step([Step(StereoView(pair.left, pair.right, RIG, 1), None, 1)])
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
            found = np.nan_to_num(result.disparity_px, nan=0)  # a disparity of zero is no depth
            np.testing.assert_array_equal(found, direct.offset_px)
    by_hand = disparity_by_hand(layout, path, pair)
    assert epe(direct.offset_px, pair) == epe(by_hand, pair)
