"""Graphs stepped by evaluation and studies."""

from pathlib import Path

import numpy as np
import pytest

from tests.support.weights_copy import WEIGHTS, Entry, copied_weights
from vergence_models.evaluation.stepping import Footage, FootageView, OnnxNetwork, StepInputs
from vergence_proto.geometry import Pose, RectifiedRig

HEIGHT, WIDTH = 40, 70


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_stages_answer_bit_for_bit_what_the_whole_graph_answers(threads: int) -> None:
    whole, staged = (OnnxNetwork(WEIGHTS, name, threads=threads) for name in ("whole", "staged"))
    random = np.random.default_rng(1)
    state = once = whole.cold_state(HEIGHT, WIDTH, batch=2)
    for iterations in (2, 1, 1):
        left, right = random.integers(0, 255, (2, 2, HEIGHT, WIDTH, 3), np.uint8)
        motion = random.uniform(-1, 1, (2, 4, 4)).astype(np.float32)
        disparity, sigma, state = whole.run(StepInputs(left, right, motion, state), iterations)
        in_stages, its_sigma, once = staged.run(StepInputs(left, right, motion, once), iterations)
        np.testing.assert_array_equal(in_stages, disparity)
        np.testing.assert_array_equal(its_sigma, sigma)
        np.testing.assert_array_equal(once, state)


def test_a_start_runs_the_cold_graphs(tmp_path: Path) -> None:
    def start_otherwise(entry: Entry) -> None:
        entry["cold_graphs"] = {"1": entry["graphs"]["2"]}
        entry["cold_max_pixels"] = HEIGHT * WIDTH

    network = OnnxNetwork(copied_weights(tmp_path, edit=start_otherwise), "staged")
    left, right = np.random.default_rng(2).integers(0, 255, (2, 1, HEIGHT, WIDTH, 3), np.uint8)
    still, nothing = np.eye(4, dtype=np.float32)[None], network.cold_state(HEIGHT, WIDTH)
    started, once, twice = (
        network.start(left, right, 1),
        network.run(StepInputs(left, right, still, nothing), 1),
        network.run(StepInputs(left, right, still, nothing), 2),
    )
    np.testing.assert_array_equal(started[0], twice[0])
    assert not np.array_equal(started[0], once[0])


def test_without_memory_a_sequence_is_a_row_of_single_frames() -> None:
    network = OnnxNetwork(WEIGHTS, "matcher")
    random = np.random.default_rng(3)
    poses = [Pose(np.eye(3), np.array([0.1 * i, 0.0, 0.0])) for i in range(3)]
    views = []
    for i, pose in enumerate(poses):
        left = random.integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
        views.append(FootageView(left, np.roll(left, -2 - i, axis=1), pose))
    rig = RectifiedRig(WIDTH, HEIGHT, 60.0, 60.0, 34.5, 34.5, 19.5, 0.1)
    predicted = [*network.sequence(Footage("three", rig, views), cold=1, warm=1)]
    for i, (view, each) in enumerate(zip(views, predicted, strict=True)):
        alone = network.start(view.left[None], view.right[None], 1)
        np.testing.assert_array_equal(each.disparity_px, alone.disparity_px[0])
        assert np.median(each.disparity_px[5:-5, 16:]) == 2 + i
