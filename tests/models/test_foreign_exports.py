"""RAFT-Stereo's realtime network from PyTorch's exporter: served, it is the one in PyTorch."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from tests.support.moved_flow import moved_flow
from vergence_models.config import RaftNetworkConfig
from vergence_models.foreign.adding import add_model
from vergence_models.foreign.guess import Given
from vergence_models.foreign.textures import scene
from vergence_models.networks.raft.network import RaftNetwork, RaftState
from vergence_models.networks.raft.update import CELL_PX, pyramid
from vergence_proto.geometry import Pose, RectifiedRig
from vergence_service.inference.model import RecurrentState, Step, StereoView
from vergence_service.inference.onnx_model import OnnxStereoModel

HEIGHT, WIDTH = 96, 256
ITERATIONS = 2
RIG = RectifiedRig(WIDTH, HEIGHT, 200.0, 200.0, 127.5, 127.5, 47.5, 0.1)


class RaftStereo(nn.Module):
    """`full` by RAFT-Stereo's contract: images in bytes, a flow to the left, flow_init at 1/8.

    Its layers are those of RAFT-Stereo's realtime network, and narrower. Where the flow is zero,
    the first disparity is the context's own.
    """

    def __init__(self, network: RaftNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(
        self, image1: torch.Tensor, image2: torch.Tensor, flow_init: torch.Tensor
    ) -> torch.Tensor:
        left, right = (each.permute(0, 2, 3, 1) for each in (image1, image2))
        _, channels8, _ = (each.channels for each in self.network.state_tensors)
        _, _, height, width = flow_init.shape
        nothing = RaftState(
            torch.zeros(1, 1, height, width),
            torch.zeros(1, channels8, height, width),
            torch.zeros(1, channels8, height // 2, width // 2),
        )
        _, given, moving = self.network.begin(left, right, torch.eye(4)[None], nothing)
        at = -CELL_PX * flow_init[:, :1]
        moving = moving._replace(disparity=torch.where(at > 0, at, moving.disparity))
        levels = pyramid(given.pairs)
        for _ in range(ITERATIONS):
            moving = self.network.iterate(given, levels, moving)
        disparity, _, _ = self.network.end(moving)
        return -disparity[:, None]


def random_network() -> RaftNetwork:
    """Random weights, also where training starts from zero: every layer changes the result."""
    torch.manual_seed(2)
    config = RaftNetworkConfig(
        warp=False,
        encoder_half=16, encoder_quarter=24, encoder_eighth=32, features=32, hidden=16, motion=8,
        head=16,
    )  # fmt: skip
    network = RaftNetwork(config).eval()
    for layer in network.modules():
        if isinstance(layer, nn.Conv2d) and not layer.weight.any():
            nn.init.normal_(layer.weight, std=0.03)
    return network


@pytest.mark.slow  # the exporter
@pytest.mark.usefixtures("quick_export")
@pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")  # torch's own
def test_an_exported_network_is_served_as_it_is_in_pytorch_warm_and_cold(tmp_path: Path) -> None:
    network = RaftStereo(random_network()).eval()
    image = torch.zeros(1, 3, HEIGHT, WIDTH)
    flow = torch.zeros(1, 2, HEIGHT // CELL_PX, WIDTH // CELL_PX)
    path = tmp_path / "raft_iter2.onnx"
    torch.onnx.export(network, (image, image.clone(), flow), path, dynamo=True, verbose=False)
    given = Given(like="raft-stereo")
    add_model({2: path}, tmp_path, name="random", given=given, unproven=True)
    model = OnnxStereoModel(tmp_path, "random", providers=["cpu"], threads=1, allow_spinning=False)
    state: RecurrentState | None = None
    last_px = np.zeros((HEIGHT, WIDTH), np.float32)
    for i in range(3):
        pair = scene(HEIGHT, WIDTH, 6, 30, seed=i)
        turned = np.radians(0.5 * i)
        rotation = np.array(
            [[np.cos(turned), 0, np.sin(turned)], [0, 1, 0], [-np.sin(turned), 0, np.cos(turned)]]
        )
        pose = Pose(rotation, np.array([0.02 * i, 0.0, 0.0]))
        step = Step(StereoView(pair.left, pair.right, RIG, i + 1, pose), state, 2)
        if state is not None:
            flow = moved_flow(last_px, step.uvd_curr_from_prev, cell_px=CELL_PX)
            assert (flow[:, 0] != 0).float().mean() > 0.8
        views = [
            torch.from_numpy(each.astype(np.float32)).permute(2, 0, 1)[None]
            for each in (pair.left, pair.right)
        ]
        with torch.inference_mode():
            expected = -network(*views, flow)[0, 0].numpy()
            cold = -network(*views, torch.zeros_like(flow))[0, 0].numpy()
        assert (np.abs(expected - cold).mean() > 0.05) == (state is not None)
        [result] = model.step([step])
        state, last_px = result.state, result.offset_px
        np.testing.assert_allclose(result.offset_px, expected, atol=1e-3)
