"""Laws of the network and its exported graphs."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from numpy.typing import NDArray
from torch import nn

from tests.support.trained import as_trained
from vergence_models.config import Config, LiteNetworkConfig, StepKind
from vergence_models.evaluation.stepping import OnnxNetwork, StepInputs
from vergence_models.export import (
    PARITY_PX,
    check_parity,
    export_run,
    shifted_pair,
)
from vergence_models.networks.layers import all_pairs, banded, best_rival
from vergence_models.networks.lite.network import LiteNetwork, LiteState
from vergence_models.onnx_export.modules import COLUMNS, GraphPart, export_part
from vergence_models.training.runs import Run

HEIGHT, WIDTH = 192, 256


@pytest.fixture(scope="module")
def network() -> LiteNetwork:
    torch.manual_seed(3)
    return as_trained(LiteNetwork(LiteNetworkConfig()))


def views(seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    left, right = shifted_pair(HEIGHT, WIDTH, seed)
    return torch.from_numpy(left), torch.from_numpy(right)


def test_an_untrained_network_already_matches() -> None:
    torch.manual_seed(3)
    network = LiteNetwork(LiteNetworkConfig()).eval()
    left, right = views(0)
    with torch.inference_mode():
        estimate, _ = network(
            left, right, torch.eye(4)[None], network.cold_state(1, *(left.shape[1:3])), 1
        )
    truth = torch.linspace(4, 40, HEIGHT).floor()[:, None].expand(HEIGHT, WIDTH)
    seen = torch.arange(WIDTH) >= 48  # the rest has no match in the right image
    error = (estimate.disparity[0] - truth).abs()[:, seen]
    assert error.median() < 0.5
    assert (error > 3).float().mean() < 0.1


@pytest.mark.slow  # the exporter
@pytest.mark.usefixtures("quick_export")
def test_the_graph_equals_pytorch_frame_by_frame(network: LiteNetwork, tmp_path: Path) -> None:
    run = Run("lite", network.config, network.state_dict(), story={}, measured={})
    export_run(
        run, Config("lite", network.config, iterations=(1, 2), iterations_at_2x={2: 1}), tmp_path
    )
    graphs = OnnxNetwork(tmp_path, "lite")
    for kind in (StepKind(1), StepKind(2), StepKind(2, at_2x=1)):
        assert check_parity(network, graphs, kind, frames=4) < PARITY_PX
    # Both counts begin with the same two graphs.
    assert graphs.card.graphs[1][0] == graphs.card.graphs[2][0]
    assert len(graphs.card.graphs[1][0]) == 2
    assert graphs.card.cold_graphs[2] != graphs.card.graphs[2]


def test_a_second_iteration_is_a_second_look_at_the_same_frame(network: LiteNetwork) -> None:
    left, right = views(3)
    still, state = torch.eye(4)[None], network.cold_state(1, HEIGHT, WIDTH)
    with torch.inference_mode():
        once, state = network(left, right, still, state, 1)
        again, following = network(left, right, still, state, 1)
        at_once, expected = network(left, right, still, network.cold_state(1, HEIGHT, WIDTH), 2)
    # A motion of nothing is computed like any other; so not to the bit on every machine.
    assert torch.allclose(again.disparity, at_once.disparity, atol=1e-2)
    for tensor, other in zip(following, expected, strict=True):
        assert torch.allclose(tensor, other, atol=1e-2)
    assert (once.disparity - again.disparity).abs().mean() > 0.02  # it made a difference


def test_rows_of_a_pytorch_batch_are_independent(network: LiteNetwork) -> None:
    a, b = views(1), views(2)
    state = LiteState(
        torch.rand(2, 1, HEIGHT // 4, WIDTH // 4) * 30,
        torch.randn(2, network.config.hidden, HEIGHT // 8, WIDTH // 8),
    )
    matrix = torch.eye(4).repeat(2, 1, 1)
    matrix[1, 0, 3] = 3.0
    with torch.inference_mode():
        both, _ = network(torch.cat((a[0], b[0])), torch.cat((a[1], b[1])), matrix, state, 1)
        alone, _ = network(*b, matrix[1:], LiteState(state.disparity[1:], state.hidden[1:]), 1)
    # PyTorch picks its convolution by batch size, so not to the bit.
    assert (both.disparity[1] - alone.disparity[0]).abs().mean() < 1e-3


def test_a_row_of_a_batch_does_not_hear_its_neighbours(shipped: OnnxNetwork) -> None:
    pairs = [shifted_pair(HEIGHT, WIDTH, seed) for seed in range(3)]
    random = np.random.default_rng(0)
    state = tuple(
        random.uniform(0, 9, (3, *tensor.shape(HEIGHT, WIDTH))).astype(np.float32)
        for tensor in shipped.card.state
    )
    matrix = np.eye(4, dtype=np.float32)[None].repeat(3, axis=0)
    matrix[:, 0, 3] = (0.0, 2.5, -4.0)

    def step(rows: list[int]) -> list[NDArray[np.float32]]:
        left, right = (np.concatenate([pair[eye] for pair in pairs])[rows] for eye in (0, 1))
        inputs = StepInputs(left, right, matrix[rows], tuple(t[rows] for t in state))
        disparity, sigma, following = shipped.run(inputs, 1)
        return [disparity, sigma, *following]

    # To the bit, in batches of one size; how a kernel sums may depend on how many rows there are.
    together = step([0, 1, 2])
    for row in range(3):
        for among_itself, all_of in zip(step([row, row, row]), together, strict=True):
            np.testing.assert_array_equal(among_itself[row], all_of[row])


def test_shipped_graphs_agree_whatever_the_size(shipped: OnnxNetwork) -> None:
    for height, width in ((192, 224), (224, 256), (480, 640)):
        left, right = shifted_pair(height, width, 4)
        still, nothing = np.eye(4, dtype=np.float32)[None], shipped.cold_state(height, width)
        inputs = StepInputs(left, right, still, nothing)
        disparity, sigma, following = shipped.run(inputs, 4)
        assert disparity.shape == sigma.shape == (1, height, width)
        assert disparity.min() > 0
        assert sigma.min() > 0
        for tensor, value in zip(shipped.card.state, following, strict=True):
            assert value.shape == (1, *tensor.shape(height, width))
        truth = np.linspace(4, 40, height).astype(int)[:, None]
        assert np.median(np.abs(disparity[0, :, 48:] - truth)) < 0.5


@pytest.mark.parametrize("ratio", [1, 2])
def test_banded_reindexes_pairs_by_disparity(ratio: int) -> None:
    pairs = torch.randn(2, 3, 10, 10 * ratio)
    volume = banded(pairs, 6)
    for x in range(10):
        for d in range(6):
            right = ratio * x - d
            expected = pairs[:, :, x, right] if right >= 0 else torch.zeros(2, 3)
            assert torch.equal(volume[:, :, x, 5 - d], expected)


@pytest.mark.parametrize("ratio", [1, 2, 3])
def test_best_rival_is_the_best_score_of_the_right_pixel(ratio: int) -> None:
    bins = 6
    scores = torch.randn(2, bins, 3, 8)
    rival = best_rival(scores, ratio)
    for x, d in itertools.product(range(8), range(bins)):
        right = max(ratio * x - d, 0)
        meeting = [(other, ratio * other - right) for other in range(8)]
        claims = [
            scores[:, bins - 1 - there, :, other] for other, there in meeting if 0 <= there < bins
        ]
        assert torch.equal(rival[:, bins - 1 - d, :, x], torch.stack(claims).amax(dim=0))


def test_all_pairs_is_the_mean_product_of_descriptors() -> None:
    left, right = torch.randn(1, 6, 2, 4), torch.randn(1, 6, 2, 8)
    expected = torch.einsum("bchx,bchy->bhxy", left, right) / 6
    assert torch.allclose(all_pairs(left, right), expected, atol=1e-6)


class Clamped(nn.Module):
    """Columns that lie outside of an image, moved to its border."""

    def forward(self, *inputs: torch.Tensor) -> torch.Tensor:
        (columns,) = inputs
        return columns.clamp(0, columns.shape[1] - 1) + 0.5


@pytest.mark.slow
def test_a_clamp_to_a_size_is_one_operator(tmp_path: Path) -> None:
    path = tmp_path / "clamped.onnx"
    export_part(
        GraphPart(Clamped(), (torch.zeros(1, 16),), ({1: 8 * COLUMNS},), ("x",), ("y",)), path
    )
    operators = [node.op_type for node in onnx.load(path).graph.node]
    assert operators.count("Clip") == 1
    assert not {"Max", "Min"} & set(operators)
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    columns = np.arange(-4, 28, dtype=np.float32)[None]
    (got,) = session.run(None, {"x": columns})
    np.testing.assert_array_equal(got, columns.clip(0, 31) + 0.5)
