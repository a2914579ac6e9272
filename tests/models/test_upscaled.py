"""Laws of 2x refinement: downsampling restores a state, and the surer of two results is kept."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from vergence_models.config import FAST_NETWORK, LiteNetworkConfig
from vergence_models.evaluation.stepping import OnnxNetwork, StepInputs
from vergence_models.networks.base import StepOutput
from vergence_models.networks.lite.network import LiteNetwork
from vergence_models.networks.lite.upscaled import (
    ELSEWHERE_PX,
    SIGMA_SCALE,
    halved,
    joined,
    larger_image,
    larger_state,
)
from vergence_models.networks.raft.network import RaftNetwork

HEIGHT, WIDTH = 64, 96
MOST_PX = 192


def test_a_ramp_is_a_ramp_at_twice_the_size() -> None:
    ramp = torch.arange(0, 2 * WIDTH, 2, dtype=torch.uint8).expand(3, HEIGHT, WIDTH)
    image = ramp.permute(1, 2, 0)[None].contiguous()
    larger = larger_image(image)
    assert larger.dtype == torch.uint8
    assert larger.shape == (1, 2 * HEIGHT, 2 * WIDTH, 3)
    # Pixel centres lie at whole numbers: those of the larger image at quarters from them.
    columns = (torch.arange(2 * WIDTH) + 0.5) / 2 - 0.5
    expected = (2 * columns).clamp(0, 2 * WIDTH - 2)
    assert (larger[0, :, :, 1].float() - expected).abs().max() <= 0.5


@given(seed=st.integers(0, 99))
def test_a_state_comes_back_as_it_was(seed: int) -> None:
    torch.manual_seed(seed)
    disparity, hidden = torch.rand(2, 1, 16, 24) * 90, torch.randn(2, 5, 8, 12)
    larger, larger_hidden = larger_state(disparity, hidden)
    assert larger.shape == (2, 1, 32, 48)
    assert torch.allclose(0.5 * halved(larger), disparity, rtol=1e-5)
    assert torch.allclose(halved(larger_hidden), hidden, rtol=1e-5, atol=1e-6)


def found(disparity_px: Tensor, sigma_px: Tensor) -> StepOutput:
    """At any size; the state has the disparity of the middle of its cells."""
    height, width = disparity_px.shape[1:]
    state = disparity_px[:, None, 2::4, 2::4], torch.zeros(1, 3, height // 8, width // 8)
    return StepOutput(disparity_px, sigma_px, state)


def twice(plane: Tensor) -> Tensor:
    """As a look at twice the size would have it."""
    return 2 * plane.repeat_interleave(2, dim=1).repeat_interleave(2, dim=2)


@given(seed=st.integers(0, 99))
def test_each_pixel_keeps_one_of_two_and_the_state_agrees(seed: int) -> None:
    random = np.random.default_rng(seed)

    def plane(low: float, high: float) -> Tensor:
        values = random.uniform(low, high, (1, HEIGHT // 4, WIDTH // 4)).astype(np.float32)
        return torch.from_numpy(values).repeat_interleave(4, 1).repeat_interleave(4, 2)

    before, doubt = plane(1, 120), plane(0.1, 4)
    after, its_doubt = plane(1, 95), plane(0.1, 4)
    larger = found(twice(after), twice(its_doubt) / (2 * SIGMA_SCALE))
    answer = joined(found(before, doubt), larger, MOST_PX)
    too_near = before > MOST_PX / 2 - 4
    worse = ((after - before).abs() > ELSEWHERE_PX) & (its_doubt > doubt)
    kept = too_near | worse
    assert torch.allclose(answer.disparity, torch.where(kept, before, after), rtol=1e-5)
    assert torch.allclose(answer.sigma, torch.where(kept, doubt, its_doubt), rtol=1e-5)
    disparity, hidden = answer.state
    assert torch.allclose(disparity[:, 0], answer.disparity[:, 2::4, 2::4], rtol=1e-5)
    assert hidden.shape == (1, 3, HEIGHT // 8, WIDTH // 8)


def test_a_cold_step_without_2x_refinement_is_any_first_step() -> None:
    torch.manual_seed(5)
    network = LiteNetwork(LiteNetworkConfig()).eval()
    left, right = torch.randint(0, 255, (2, 1, 192, 256, 3), dtype=torch.uint8)
    with torch.inference_mode():
        cold = network.cold_step(left, right, 2)
        usual, _ = network(left, right, torch.eye(4)[None], network.cold_state(1, 192, 256), 2)
        at_2x = network.cold_step(left, right, 2, at_2x=1)
    assert torch.equal(cold.disparity, usual.disparity)
    assert not torch.allclose(at_2x.disparity, usual.disparity, atol=0.1)
    assert [each.shape for each in at_2x.state] == [each.shape for each in cold.state]


def test_a_tier_without_2x_refinement_says_so() -> None:
    network = RaftNetwork(FAST_NETWORK).eval()
    image = torch.zeros(1, 192, 256, 3, dtype=torch.uint8)
    with pytest.raises(ValueError, match="RaftNetwork cannot refine at 2x, got 1 iterations"):
        network.cold_step(image, image, 2, at_2x=1)


def test_2x_refinement_finds_bars_that_are_thinner_than_a_cell(shipped: OnnxNetwork) -> None:
    wall_px, bar_px, width = 6, 16, 3
    random = np.random.default_rng(11)
    left, right = (np.zeros((192, 256, 3), np.uint8) for _ in range(2))
    wall, bars = random.integers(60, 130, (2, 192, 300, 3), np.uint8)
    left[:], right[:] = wall[:, :256], wall[:, wall_px : wall_px + 256]
    truth = np.full((192, 256), wall_px)
    for column in range(40, 230, 24):
        bar = bars[:, column : column + width] + 90
        left[:, column : column + width] = bar
        right[:, column - bar_px : column - bar_px + width] = bar
        truth[:, column : column + width] = bar_px
    still, nothing = np.eye(4, dtype=np.float32)[None], shipped.cold_state(192, 256)
    plain, *_ = shipped.run(StepInputs(left[None], right[None], still, nothing), 8)
    at_2x, *_ = shipped.start(left[None], right[None], 8)
    missed = [np.mean(np.abs(each[0] - truth)[truth == bar_px] > 2) for each in (plain, at_2x)]
    assert missed[1] < missed[0]
