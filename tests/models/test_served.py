"""The law of the science side: what the server streams is what PyTorch computes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from tests.support.server import running_server
from vergence import Delivery, DepthClient, OutputFormat, PlaneEncoding, RectifiedRig
from vergence_models import export
from vergence_models.evaluate import WEIGHTS
from vergence_models.export import shifted_pair
from vergence_models.networks.base import AnyNetwork
from vergence_models.onnx_export import calibrate
from vergence_models.training.runs import read_run, trained_network
from vergence_proto.geometry import Pose, uvd_curr_from_prev
from vergence_proto.model_io import MANIFEST_NAME
from vergence_service.inference.onnx_model import OnnxStereoModel

# The run that the shipped graphs were exported from.
RUN = Path(__file__).parents[2] / "models" / "runs" / "lite"
FRAMES = 4
RIG = RectifiedRig(256, 192, 200.0, 200.0, 127.5, 127.5, 95.5, 0.1)
STEP_M = 0.004

Pair = tuple[NDArray[np.uint8], NDArray[np.uint8]]


def footage() -> list[tuple[Pair, Pose]]:
    """A camera that pans along a slanted wall, with poses that say so."""
    return [
        (
            shifted_pair(RIG.height, RIG.width, 0, pan_px=2 * index),
            Pose(np.eye(3), np.array([STEP_M * index, 0.0, 0.0])),
        )
        for index in range(FRAMES)
    ]


def by_pytorch(network: AnyNetwork) -> list[NDArray[np.float32]]:
    state = network.cold_state(1, RIG.height, RIG.width)
    world_from_prev, maps = Pose.identity(), []
    for (left, right), world_from_curr in footage():
        curr_from_prev = world_from_curr.inverse() @ world_from_prev
        with torch.inference_mode():
            estimate, state = network(
                torch.from_numpy(left),
                torch.from_numpy(right),
                torch.from_numpy(uvd_curr_from_prev(RIG, curr_from_prev))[None],
                state,
                1,
            )
        maps.append(estimate.disparity[0].numpy())
        world_from_prev = world_from_curr
    return maps


async def test_streamed_equals_pytorch_frame_by_frame() -> None:
    run = read_run(RUN)
    network = trained_network(run)
    model = OnnxStereoModel(WEIGHTS, "lite", providers=["cpu"], threads=2, allow_spinning=False)
    exact = OutputFormat(encoding=PlaneEncoding.FLOAT32)
    async with (
        running_server(model) as server,
        DepthClient(server.grpc_address) as client,
        client.open_session(
            RIG, delivery=Delivery.EVERY, output=exact, iterations=1, cold_iterations=1
        ) as session,
    ):
        streamed = [await session.step(*pair_of(each), each[1]) for each in footage()]
    assert [result.step_count for result in streamed] == [1, 2, 3, 4]
    for result, expected in zip(streamed, by_pytorch(network), strict=True):
        # The tolerances are the export's own, which say why they are of 99 pixels in 100.
        assert np.nanquantile(np.abs(result.offset_px - expected), 0.99) < tolerance_px()


def tolerance_px() -> float:
    """Float graphs were held to theirs before they were made int8."""
    manifest = json.loads((WEIGHTS / MANIFEST_NAME).read_text("utf-8"))
    int8 = "int8" in manifest["models"]["lite"]
    return calibrate.PARITY_PX if int8 else export.PARITY_PX


def pair_of(each: tuple[Pair, Pose]) -> Pair:
    (left, right), _ = each
    return left[0], right[0]
