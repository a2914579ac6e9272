"""Graphs stepped by evaluation and studies."""

import numpy as np
import pytest

from tests.support.weights_copy import WEIGHTS
from vergence_models.stepping import OnnxNetwork

HEIGHT, WIDTH = 40, 70


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_stages_answer_bit_for_bit_what_the_whole_graph_answers(threads: int) -> None:
    whole, staged = (OnnxNetwork(WEIGHTS, name, threads=threads) for name in ("whole", "staged"))
    random = np.random.default_rng(1)
    state = once = whole.cold_state(HEIGHT, WIDTH, batch=2)
    for iterations in (2, 1, 1):
        left, right = random.integers(0, 255, (2, 2, HEIGHT, WIDTH, 3), np.uint8)
        motion = random.uniform(-1, 1, (2, 4, 4)).astype(np.float32)
        disparity, sigma, state = whole.run(left, right, motion, state, iterations)
        in_stages, its_sigma, once = staged.run(left, right, motion, once, iterations)
        np.testing.assert_array_equal(in_stages, disparity)
        np.testing.assert_array_equal(its_sigma, sigma)
        np.testing.assert_array_equal(once, state)
