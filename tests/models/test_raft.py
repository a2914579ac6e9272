"""Laws of `full` and `fast`: of their steps, their graphs, and where their state comes from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from tests.support.trained import as_trained
from vergence_models.config import Config, RaftNetworkConfig, StepKind
from vergence_models.evaluation.stepping import OnnxNetwork
from vergence_models.export import PARITY_PX, check_parity, export_run, shifted_pair
from vergence_models.networks.raft.network import RaftNetwork, RaftState
from vergence_models.networks.raft.update import looked_up, pyramid
from vergence_models.onnx_export.modules import export_part, folded
from vergence_models.onnx_export.raft_parts import parts_of
from vergence_models.training.runs import Run
from vergence_proto.model_io import ManifestError, load_model_card

HEIGHT, WIDTH = 96, 224
TINY = {
    "encoder_half": 8,
    "encoder_quarter": 8,
    "encoder_eighth": 16,
    "features": 16,
    "hidden": 16,
    "motion": 8,
    "head": 16,
}


def tiny_network(*, warp: bool = True) -> RaftNetwork:
    torch.manual_seed(5)
    return as_trained(RaftNetwork(RaftNetworkConfig(warp=warp, **TINY)))


def views(seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    left, right = shifted_pair(HEIGHT, WIDTH, seed)
    return torch.from_numpy(left), torch.from_numpy(right)


def test_the_images_reach_the_answer() -> None:
    """Or all that is compared below would be constants."""
    network = tiny_network()
    still, state = torch.eye(4)[None], network.cold_state(1, HEIGHT, WIDTH)
    with torch.inference_mode():
        one, other = (network(*views(seed), still, state, 2)[0].disparity for seed in (1, 2))
    assert (one - other).abs().mean() > 0.1


@pytest.mark.slow  # the exporter
@pytest.mark.usefixtures("quick_export")
def test_exported_graphs_equal_pytorch_and_share_their_weights(tmp_path: Path) -> None:
    network = tiny_network()
    run = Run("full", network.config, network.state_dict(), story={}, measured={})
    export_run(run, Config("full", network.config, iterations=(1, 3)), tmp_path)

    card = load_model_card(tmp_path, "full")
    assert card.state == network.state_tensors
    weights = tmp_path / "full.weights"
    graphs = OnnxNetwork(tmp_path, "full")
    for count, ((path,),) in card.graphs.items():
        assert check_parity(network, graphs, StepKind(count), frames=4) < PARITY_PX
        kinds = {node.op_type for node in onnx.load(path, load_external_data=False).graph.node}
        assert not kinds & {"BatchNormalization", "Loop", "If"}
    stored = sum(p.numel() * 4 for p in folded(network).parameters())
    assert stored / 2 < weights.stat().st_size < stored * 2  # once, not once a count

    content = bytearray(weights.read_bytes())
    content[len(content) // 2] ^= 1
    weights.write_bytes(content)
    with pytest.raises(ManifestError, match=r"full.weights: expected sha256"):
        load_model_card(tmp_path, "full")


@pytest.mark.slow  # the exporter
@pytest.mark.usefixtures("quick_export")
def test_the_exported_beginning_without_a_warp_equals_pytorch(tmp_path: Path) -> None:
    """Of `fast`. What follows it is the code of `full`, to the last operation."""
    network = folded(tiny_network(warp=False))
    (begin,), path = parts_of(network).begin, tmp_path / "begin.onnx"
    export_part(begin, path)
    moved = torch.eye(4).repeat(2, 1, 1)
    moved[1, 0, 3] = 9.0
    (left, right), (other_left, other_right) = views(1), views(2)
    inputs = (
        torch.cat((left, other_left)),
        torch.cat((right, other_right)),
        moved,
        torch.rand(2, 1, HEIGHT // 8, WIDTH // 8) * 30,
        torch.randn(2, 16, HEIGHT // 8, WIDTH // 8),
        torch.randn(2, 16, HEIGHT // 16, WIDTH // 16),
    )
    with torch.inference_mode():
        expected = begin.module(*inputs)
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    feeds = dict(zip(begin.input_names, (tensor.numpy() for tensor in inputs), strict=True))
    found = session.run(begin.output_names, feeds)
    for got, tensor in zip(found, expected, strict=True):
        # They sum in different orders.
        np.testing.assert_allclose(got, tensor.numpy(), atol=1e-3)


def test_folding_batch_norms_changes_no_result() -> None:
    network = tiny_network()
    state = network.cold_state(1, HEIGHT, WIDTH)
    with torch.inference_mode():
        expected, _ = network(*views(0), torch.eye(4)[None], state, 2)
        got, _ = folded(network)(*views(0), torch.eye(4)[None], state, 2)
    assert not any(isinstance(m, torch.nn.BatchNorm2d) for m in folded(network).modules())
    assert torch.allclose(got.disparity, expected.disparity, atol=1e-3)


def test_rows_of_a_batch_are_independent() -> None:
    network = tiny_network()
    a, b = views(1), views(2)
    state = RaftState(
        torch.rand(2, 1, HEIGHT // 8, WIDTH // 8) * 30,
        torch.randn(2, 16, HEIGHT // 8, WIDTH // 8),
        torch.randn(2, 16, HEIGHT // 16, WIDTH // 16),
    )
    matrix = torch.eye(4).repeat(2, 1, 1)
    matrix[1, 0, 3] = 3.0
    with torch.inference_mode():
        both, _ = network(torch.cat((a[0], b[0])), torch.cat((a[1], b[1])), matrix, state, 1)
        alone, _ = network(*b, matrix[1:], tuple(tensor[1:] for tensor in state), 1)
    # PyTorch picks its convolution by batch size, so not to the bit.
    assert (both.disparity[1] - alone.disparity[0]).abs().mean() < 1e-3


def test_a_warm_step_goes_on_where_the_last_one_ended() -> None:
    """With a still camera, two steps of one iteration are one step of two."""
    network = tiny_network()
    left, right = views(3)
    still, state = torch.eye(4)[None], network.cold_state(1, HEIGHT, WIDTH)
    with torch.inference_mode():
        _, state = network(left, right, still, state, 1)
        twice, _ = network(left, right, still, state, 1)
        at_once, _ = network(left, right, still, network.cold_state(1, HEIGHT, WIDTH), 2)
    assert torch.allclose(twice.disparity, at_once.disparity, atol=1e-2)


def test_without_a_warp_the_motion_is_not_heard() -> None:
    network = tiny_network(warp=False)
    _, state = network(*views(4), torch.eye(4)[None], network.cold_state(1, HEIGHT, WIDTH), 1)
    moved = torch.eye(4)[None].clone()
    moved[0, 0, 3] = 9.0
    still_seen, moved_seen = (
        network(*views(4), matrix, state, 1)[0].disparity for matrix in (torch.eye(4)[None], moved)
    )
    assert torch.equal(still_seen, moved_seen)


def test_the_lookup_of_every_level_is_centred_on_the_match() -> None:
    columns = 32
    pairs = (torch.arange(columns) == 12).float().expand(1, 1, columns, columns)
    d = (torch.arange(columns) - 12.0).view(1, 1, 1, columns) * 8  # all look at column 12
    found = looked_up(pyramid(pairs), d)[0, :, 0, 20].view(4, 9)
    assert found[0].tolist() == [0, 0, 0, 0, 1, 0, 0, 0, 0]
    for level in (1, 2, 3):
        # An average over 2^k cells, interpolated between two such averages round the match.
        assert found[level, 3:6].sum() == pytest.approx(1 / 2**level)
        assert found[level, :3].sum() == found[level, 6:].sum() == 0
