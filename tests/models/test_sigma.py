"""Laws of sigma: it follows what the two images show, and nothing follows it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from torch import Tensor

from vergence_models.config import LITE_TRAINING, LiteNetworkConfig, load_config
from vergence_models.evaluate import WEIGHTS
from vergence_models.evaluation.evidence import SURE, doubt, kinds
from vergence_models.evaluation.stepping import OnnxNetwork
from vergence_models.networks.lite.ambiguity import FEATURES, SigmaHead, ambiguity
from vergence_models.networks.lite.network import LiteNetwork
from vergence_models.train_sigma import PART, put_into
from vergence_models.training.runs import load_checkpoint
from vergence_models.training.sigma_fit import fit_sigma, predicted
from vergence_models.training.sigma_samples import SigmaSamples
from vergence_models.training.trainer import Trainer
from vergence_proto.model_io import MANIFEST_NAME

RUN = Path(__file__).parents[2] / "models" / "runs" / "lite"
BINS = 48
SHARES_PCT = {1: 63.2, 2: 86.5, 3: 95.0}
HELD_OUT_POINTS = 6


@pytest.mark.parametrize(
    "kind",
    [
        "black, both eyes",
        "covered lens, left eye",
        "gradient, both eyes",
        "stripes of 16 px",
        "checks of 16 px",
        "tiles of 32 px",
        "bars along the rows",
        "8 px beyond the range",
    ],
)
def test_no_evidence_gives_no_confidence_cold_and_in_mid_stream(
    shipped: OnnxNetwork, kind: str
) -> None:
    """The images are not those of training. In mid-stream it is the second frame of them."""
    found = doubt(shipped, dict(kinds(shipped.card.max_disparity_px))[kind])
    assert max(found.cold, found.warm) < SURE
    if "beyond" in kind:
        assert max(found.cold_sure_pct, found.warm_sure_pct) <= 2


def test_shares_of_held_out_errors_are_those_of_the_laplace_distribution() -> None:
    manifest = json.loads((WEIGHTS / MANIFEST_NAME).read_text("utf-8"))
    held_out = manifest["models"]["lite"]["measured"]["sigma"]
    for start in ("cold", "warm"):
        for sigmas, share in SHARES_PCT.items():
            assert abs(held_out[f"{start}_within_{sigmas}"] - share) <= HELD_OUT_POINTS


def peaks(*bins: int) -> Tensor:
    """Scores [1, D, 8, 24] with equal peaks at these disparities of 4 px."""
    scores = torch.zeros(1, BINS, 8, 24)
    for each in bins:
        scores[:, BINS - 1 - each] = 15
    return scores


def measures_of(scores: Tensor, answer_px: float) -> Tensor:
    sigma, disparity = torch.ones(1, 64, 192), torch.full((1, 1, 16, 48), answer_px)
    return ambiguity(sigma, disparity, scores)[0, :, 4, 12]


def test_a_second_match_spreads_as_far_as_it_is_away() -> None:
    spreads = [measures_of(peaks(5, 5 + apart), 20.0)[1] for apart in (0, 4, 10, 30)]
    expected = [np.log1p((4 * apart - 6) / 2) if apart else 0 for apart in (0, 4, 10, 30)]
    np.testing.assert_allclose(spreads, expected, atol=0.01)
    # The answer is elsewhere: whatever the state remembers, the images do not show it.
    assert measures_of(peaks(5), 120.0)[1] > np.log1p(90)


def test_without_any_match_all_disparities_are_equally_good() -> None:
    nothing = measures_of(torch.zeros(1, BINS, 8, 24), 20.0)
    assert nothing[0] > np.log1p(60)
    assert nothing[1] > np.log1p(60)
    assert nothing[2] == 0


def test_an_untrained_head_leaves_sigma_as_the_refinement_finds_it() -> None:
    torch.manual_seed(1)
    sigma = torch.rand(2, 64, 192) + 0.1
    found = SigmaHead()(sigma, torch.rand(2, 1, 16, 48) * 90, torch.randn(2, BINS, 8, 24))
    assert torch.allclose(found, sigma, atol=0.003)


def test_sigma_teaches_neither_disparity_nor_scores() -> None:
    head = SigmaHead()
    disparity = torch.rand(1, 1, 16, 48, requires_grad=True)
    scores = torch.randn(1, BINS, 8, 24, requires_grad=True)
    head(torch.ones(1, 64, 192), disparity, scores).sum().backward()
    assert disparity.grad is None
    assert scores.grad is None
    assert head.leave.bias is not None
    assert head.leave.bias.grad is not None


def test_sigma_is_fitted_to_the_spread_of_errors() -> None:
    """Laplace errors, as wide as one of the measures says; the refinement knows nothing."""
    torch.manual_seed(3)
    measures = torch.randn(10_000, FEATURES) * 2 + 5
    wide = measures[:, 1] > 5
    scale = torch.exp((measures[:, 1] - 5) / 2)
    error = scale * torch.empty_like(scale).exponential_()
    samples = SigmaSamples(measures, torch.ones(len(error)), error, wide, wide)
    head = SigmaHead()
    fit_sigma(head, samples, steps=120, seed=1)
    sigma = predicted(head, measures, samples.sigma)
    for part in (wide, ~wide):
        for sigmas, share in SHARES_PCT.items():
            within = 100 * float((error[part] <= sigmas * sigma[part]).float().mean())
            assert abs(within - share) < 3


def test_a_run_with_a_new_sigma_goes_on_with_its_optimizer(tmp_path: Path) -> None:
    contents = load_checkpoint(RUN)
    network = LiteNetwork(LiteNetworkConfig())
    network.load_state_dict(contents["average"])
    put_into(contents, network)
    torch.save(contents, tmp_path / "checkpoint.pt")
    trainer = Trainer(load_config("lite"), torch.device("cpu"))
    trainer.resume(tmp_path)
    names = [name for name, _ in trainer.network.named_parameters()]
    assert [name.startswith(PART) for name in names[-4:]] == [True] * 4
    state = trainer.optimizer.state_dict()["state"]
    assert set(state) == set(range(len(names) - 4))
    assert LITE_TRAINING.blinded_share > 0


def test_shipped_graphs_hold_the_sigma_of_the_run() -> None:
    average = load_checkpoint(RUN)["average"]
    for path in WEIGHTS.glob("lite_[0-9]*.onnx"):
        weights = {
            tensor.name: onnx.numpy_helper.to_array(tensor)
            for tensor in onnx.load(path).graph.initializer
        }
        for name in ("enter.weight", "leave.bias"):
            found = weights[f"sigma.network.{PART}{name}"]
            np.testing.assert_array_equal(found, average[PART + name].numpy())
