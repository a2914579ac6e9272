"""Laws of the measures: exact on what can be worked out by hand."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.support.wall_clips import wall_clips
from vergence_models.data.pool import write_shard
from vergence_models.evaluate import main
from vergence_models.evaluation.metric_accumulator import settled_frame
from vergence_models.evaluation.metrics import calibration, error_measures, temporal_error
from vergence_models.evaluation.stepping import footage_from_clip
from vergence_models.export import shifted_pair
from vergence_proto.geometry import Pose
from vergence_proto.sgbm import filled, sgbm_disparity


def test_measures_of_known_errors() -> None:
    truth = np.full((10, 10), 20, np.float32)
    truth[0] = np.nan
    predicted = truth + 0.5
    predicted[1] = 22.5  # ten of ninety are off by 2.5
    predicted[0] = 999  # unknown: not judged
    found = error_measures(predicted, truth)
    assert found is not None
    assert found["epe"] == pytest.approx((80 * 0.5 + 10 * 2.5) / 90)
    assert found["d1"] == found["bad2"] == pytest.approx(100 / 9)
    assert found["d3"] == 0
    assert found["p95"] == pytest.approx(2.5)


def test_bad_percents_are_the_percentiles_of_numpy() -> None:
    random = np.random.default_rng(0)
    truth = random.uniform(1, 60, (40, 50)).astype(np.float32)
    predicted = (truth + random.standard_cauchy(truth.shape)).astype(np.float32)
    truth[random.random(truth.shape) < 0.2] = np.nan
    found = error_measures(predicted, truth)
    assert found is not None
    error = np.abs(predicted - truth)[np.isfinite(truth)]
    for rank in (95, 97, 99):
        assert found[f"p{rank}"] == pytest.approx(np.percentile(error, rank))


def test_a_start_has_settled_once_it_is_within_ten_percent_of_the_later_mean() -> None:
    assert settled_frame([3.0, 1.2, 1.05, 1.0, 1.0, 1.0]) == 3
    assert settled_frame([1.0, 1.0, 1.0, 1.0]) == 1
    assert settled_frame([1.0, 2.0, 3.0]) is None


def test_hardly_any_truth_is_no_measure() -> None:
    truth = np.full((10, 10), np.nan, np.float32)
    truth[0, 0] = 3
    assert error_measures(truth, truth) is None
    assert calibration(truth, truth, truth) is None


def test_sigma_of_a_laplace_distribution_is_calibrated() -> None:
    random = np.random.default_rng(0)
    truth = np.full((300, 300), 10, np.float32)
    predicted = (truth + random.laplace(0, 0.7, truth.shape)).astype(np.float32)
    found = calibration(predicted, np.full_like(truth, 0.7), truth)
    assert found is not None
    assert found["within_50"] == pytest.approx(50, abs=1)
    assert found["within_90"] == pytest.approx(90, abs=1)
    shares = [found[f"within_{sigmas}_sigma"] for sigmas in (1, 2, 3)]
    assert shares == pytest.approx([63.2, 86.5, 95.0], abs=1)
    assert found["sigma_over_error"] == pytest.approx(1, abs=0.02)


def test_truth_does_not_flicker_and_a_jump_does() -> None:
    footage = footage_from_clip(wall_clips(1), 0, "wall")
    before, now = footage.views[:2]
    assert before.truth_px is not None
    assert now.truth_px is not None
    assert before.world_from_left is not None
    assert now.world_from_left is not None
    truth = before.truth_px, now.truth_px
    moved: Pose = now.world_from_left.inverse() @ before.world_from_left
    steady = truth[0] + 0.7, truth[1] + np.float32(0.7)
    jumpy = truth[0] + np.float32(0.2), truth[1] - np.float32(0.3)
    assert temporal_error(footage.rig, moved, steady, truth) == pytest.approx(0, abs=1e-5)
    assert temporal_error(footage.rig, moved, jumpy, truth) == pytest.approx(0.5, abs=1e-5)


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_sgbm_finds_the_shift(scale: float) -> None:
    left, right = shifted_pair(192, 256, 0)
    found = sgbm_disparity(left[0], right[0], max_disparity_px=64, scale=scale)
    truth = np.linspace(4, 40, 192).astype(int)[:, None]
    assert np.median(np.abs(found[:, 64:] - truth)) < 1


def test_holes_take_the_farther_side() -> None:
    row = np.array([[0, 5, 0, 0, 3, 0], [0, 0, 0, 0, 0, 0]], np.float32)
    assert filled(row).tolist() == [[5, 5, 3, 3, 3, 3], [0, 0, 0, 0, 0, 0]]


@pytest.mark.slow
def test_the_command_reports_every_method(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_shard(tmp_path / "pool" / "shard_1_000000", wall_clips(1, height=192, width=256))
    pool, out, plots = (str(tmp_path / name) for name in ("pool", "out.json", "plots"))
    main(["--pool", pool, "--json", out, "--plots", plots, "--thorough"])
    table = capsys.readouterr().out
    assert "SGBM, half size" in table
    assert "PatchMatch, warm, 1 iteration" in table
    written = json.loads((tmp_path / "out.json").read_text())["pool pool"]
    assert len(written) == 7
    for measures in written.values():
        assert len(measures["epe_by_frame"]) == 3
        assert measures["tepe"] >= 0
    assert "### pool pool" in (tmp_path / "out.md").read_text()
    assert (tmp_path / "plots" / "pool_pool.png").stat().st_size > 1000


def test_nothing_to_evaluate_on_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([])
    assert "name --data" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="no such folder"):
        main(["--data", "vergence:/nonexistent/folder/here"])
