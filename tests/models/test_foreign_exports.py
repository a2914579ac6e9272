"""A network of PyTorch's exporter, with random weights: served, it is the network in PyTorch."""

from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import nn

from tests.support.moved_flow import moved_flow
from vergence_models.foreign.adding import add_model
from vergence_models.foreign.guess import Given
from vergence_models.foreign.textures import scene
from vergence_proto.geometry import Pose, RectifiedRig
from vergence_service.inference.model import RecurrentState, Step, StereoView
from vergence_service.inference.onnx_model import OnnxStereoModel

HEIGHT, WIDTH, CELL_PX = 96, 256, 4
RIG = RectifiedRig(WIDTH, HEIGHT, 200.0, 200.0, 127.5, 127.5, 47.5, 0.1)


class RandomRaft(nn.Module):
    """RAFT-Stereo's contract with random weights: images in bytes, a flow to the left, flow_init.

    Features, a lookup round the flow, and updates of the flow at 1/4, as the published network has.
    """

    def __init__(self) -> None:
        super().__init__()
        self.features = nn.Sequential(
            nn.Conv2d(3, 16, 7, 2, 3), nn.ReLU(), nn.Conv2d(16, 16, 3, 2, 1)
        )
        self.update = nn.Sequential(
            nn.Conv2d(16 + 9, 32, 3, 1, 1), nn.ReLU(), nn.Conv2d(32, 1, 3, 1, 1)
        )

    def forward(
        self, image1: torch.Tensor, image2: torch.Tensor, flow_init: torch.Tensor
    ) -> torch.Tensor:
        left, right = (self.features(2 * each / 255 - 1) for each in (image1, image2))
        _, _, height, width = left.shape
        x = torch.arange(width).to(left.dtype)[None, None, None, :]
        y = torch.arange(height).to(left.dtype)[None, None, :, None].expand(1, 1, height, width)
        flow = flow_init[:, :1]
        for _ in range(2):
            looked = []
            for step in range(-4, 5):
                at = torch.cat((x + flow + step, y), dim=1).permute(0, 2, 3, 1)
                size = torch.tensor([width - 1, height - 1], dtype=left.dtype)
                there = F.grid_sample(right, 2 * at / size - 1, align_corners=True)
                looked.append((left * there).mean(dim=1, keepdim=True))
            change = self.update(torch.cat((left, *looked), dim=1))
            flow = flow - F.softplus(change)  # a surface is never behind infinity
        return F.interpolate(CELL_PX * flow, scale_factor=CELL_PX, mode="bilinear")


@pytest.mark.slow  # the exporter
@pytest.mark.usefixtures("quick_export")
@pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")  # torch's own
def test_an_exported_network_is_served_as_it_is_in_pytorch_warm_and_cold(tmp_path: Path) -> None:
    torch.manual_seed(2)
    network = RandomRaft().eval()
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
        views = (
            torch.from_numpy(each.astype(np.float32)).permute(2, 0, 1)[None]
            for each in (pair.left, pair.right)
        )
        with torch.inference_mode():
            expected = -network(*views, flow)[0, 0].numpy()
        [result] = model.step([step])
        state, last_px = result.state, result.offset_px
        np.testing.assert_allclose(result.offset_px, expected, atol=1e-3)
