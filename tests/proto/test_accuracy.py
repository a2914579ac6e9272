import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.strategies import rotation_about
from vergence_proto.accuracy import Accuracy, accuracy, error_tail, temporal_epe
from vergence_proto.geometry import Matrix, Pose, RectifiedRig
from vergence_proto.types import Plane

TRUTH_PX = np.full((10, 10), 20, np.float32)
RIG = RectifiedRig(64, 48, 60.0, 55.0, 31.5, 30.0, 23.5, 0.1)
# A slanted wall, n . x = distance, in the coordinates of the first camera.
NORMAL, DISTANCE_M = np.array([0.2, -0.1, 1.0]), 2.0
MOTION = Pose(rotation_about((0.2, 1, 0.1), 0.02), np.array([0.05, -0.02, 0.1]))


def wall_seen_from(curr_from_first: Pose) -> Plane:
    """The pixel offset of the wall, by intersecting each pixel's ray with it."""
    v, u = np.mgrid[: RIG.height, : RIG.width].astype(np.float64)
    rays = np.stack([(u - RIG.cx_left) / RIG.fx, (v - RIG.cy) / RIG.fy, np.ones_like(u)], axis=-1)
    normal = curr_from_first.rotation @ NORMAL
    distance_m = DISTANCE_M + normal @ curr_from_first.translation_m
    depth_m = distance_m / (rays @ normal)
    offset_px: Plane = (RIG.fx * RIG.baseline_m / depth_m + RIG.cx_left - RIG.cx_right).astype(
        np.float32
    )
    return offset_px


class TestAccuracy:
    def test_shares_are_of_pixels_off_by_more_than_the_threshold(self) -> None:
        errors = np.array([0.0, 0.5, 1.0, 1.5, 2.5, 3.5, 4.5, 5.5, -6.0, 0.0])
        found = accuracy((TRUTH_PX + errors).astype(np.float32), TRUTH_PX)
        assert found.epe_px == pytest.approx(np.abs(errors).mean())
        assert (found.n, found.d1_pct, found.bad2_pct) == (100, 60, 50)
        assert (found.d3_pct, found.d5_pct) == (40, 20)

    def test_unknown_truth_and_the_mask_leave_pixels_out(self) -> None:
        truth_px, mask = TRUTH_PX.copy(), np.ones((10, 10), np.bool_)
        truth_px[0], mask[:, 0] = np.nan, False
        predicted = TRUTH_PX.copy()
        predicted[0], predicted[:, 0] = 99, 99
        found = accuracy(predicted, truth_px, mask)
        assert (found.n, found.epe_px) == (81, 0)

    @pytest.mark.parametrize("missing", [np.nan, np.inf])
    def test_a_missing_prediction_is_a_wrong_one(self, missing: float) -> None:
        predicted = TRUTH_PX.copy()
        predicted[0, 0] = missing
        found = accuracy(predicted, TRUTH_PX)
        assert (found.n, found.d5_pct) == (100, 1)
        assert found.epe_px == pytest.approx(20 / 100)

    def test_without_truth_there_is_no_number(self) -> None:
        found = accuracy(TRUTH_PX, np.full_like(TRUTH_PX, np.nan))
        assert found.n == 0
        assert math.isnan(found.epe_px)
        assert math.isnan(error_tail(TRUTH_PX, np.full_like(TRUTH_PX, np.nan)).worst_1_pct_px)

    def test_frames_count_alike_in_a_sequence(self) -> None:
        few = Accuracy(10, 1.0, 10, 8, 6, 4)
        many = Accuracy(1000, 3.0, 30, 12, 10, 8)
        none = accuracy(TRUTH_PX, np.full_like(TRUTH_PX, np.nan))
        assert Accuracy.mean([few, none, many]) == Accuracy(1010, 2.0, 20, 10, 8, 6)
        assert Accuracy.mean([none]).n == 0

    def test_the_tail_is_of_percentiles(self) -> None:
        predicted = TRUTH_PX + np.arange(100, dtype=np.float32).reshape(10, 10)
        tail = error_tail(predicted, TRUTH_PX)
        assert tail.worst_1_pct_px == pytest.approx(0.99 * 99)
        assert tail.worst_3_pct_px == pytest.approx(0.97 * 99)
        assert tail.worst_5_pct_px == pytest.approx(0.95 * 99)


class TestTemporalError:
    def test_the_truth_itself_does_not_flicker(self) -> None:
        first, second = wall_seen_from(Pose.identity()), wall_seen_from(MOTION)
        found = temporal_epe(
            first,
            second,
            prev_truth_px=first,
            curr_truth_px=second,
            rig=RIG,
            curr_from_prev=MOTION,
        )
        assert found.n > 0.8 * first.size
        assert (found.tepe_px, found.t1_pct) == (0, 0)

    @given(st.floats(-3, 3), st.floats(-3, 3))
    def test_a_constant_error_is_none_and_its_change_is_all(
        self, before_px: float, after_px: float
    ) -> None:
        first, second = wall_seen_from(Pose.identity()), wall_seen_from(MOTION)
        found = temporal_epe(
            (first + before_px).astype(np.float32),
            (second + after_px).astype(np.float32),
            prev_truth_px=first,
            curr_truth_px=second,
            rig=RIG,
            curr_from_prev=MOTION,
        )
        change_px = abs(after_px - before_px)
        assert found.tepe_px == pytest.approx(change_px, abs=1e-5)
        if abs(change_px - 1) > 1e-4:
            assert found.t1_pct == (100 if change_px > 1 else 0)

    @pytest.mark.parametrize("motion", [MOTION, MOTION.inverse()], ids=["there", "back"])
    def test_it_is_what_following_every_point_by_hand_gives(self, motion: Pose) -> None:
        rng = np.random.default_rng(0)
        first, second = wall_seen_from(Pose.identity()), wall_seen_from(motion)
        second[10:20, 10:30] += 4  # something came between
        first[:5] = np.nan
        noisy = [
            (each + rng.normal(0, 1, each.shape)).astype(np.float32) for each in (first, second)
        ]
        noisy[0][6, 6] = np.nan  # no prediction: counts as zero
        expected = []
        for v in range(RIG.height):
            for u in range(RIG.width):
                errors = _follow(u, v, motion, first, second, noisy)
                expected += errors
        found = temporal_epe(
            *noisy, prev_truth_px=first, curr_truth_px=second, rig=RIG, curr_from_prev=motion
        )
        assert 0 < found.n == len(expected) < first.size
        assert found.tepe_px == pytest.approx(np.mean(expected), rel=1e-5)
        assert found.t1_pct == pytest.approx(100 * np.mean(np.array(expected) > 1))

    def test_too_few_points_give_no_number(self) -> None:
        first, second = wall_seen_from(Pose.identity()), wall_seen_from(MOTION)
        few = np.full_like(first, np.nan)
        few[20, :20] = first[20, :20]
        found = temporal_epe(
            first, second, prev_truth_px=few, curr_truth_px=second, rig=RIG, curr_from_prev=MOTION
        )
        assert 0 < found.n <= 20
        assert math.isnan(found.tepe_px)


def _follow(
    u: int, v: int, motion: Pose, first: Plane, second: Plane, noisy: list[Plane]
) -> list[float]:
    """One pixel's error, or none if its point is not seen again."""
    offset_px = float(first[v, u])
    disparity_px = offset_px - (RIG.cx_left - RIG.cx_right)
    if not disparity_px > 0.5:
        return []
    z = RIG.fx * RIG.baseline_m / disparity_px
    point: Matrix = np.array([(u - RIG.cx_left) / RIG.fx * z, (v - RIG.cy) / RIG.fy * z, z])
    x, y, z = motion.rotation @ point + motion.translation_m
    u_curr, v_curr = RIG.fx * x / z + RIG.cx_left, RIG.fy * y / z + RIG.cy
    if not (0 <= u_curr < RIG.width - 1 and 0 <= v_curr < RIG.height - 1):
        return []
    at = round(v_curr), round(u_curr)
    expected_px = RIG.fx * RIG.baseline_m / z + RIG.cx_left - RIG.cx_right
    if not abs(second[at] - expected_px) < 0.5:
        return []
    before, after = np.nan_to_num(float(noisy[0][v, u])), float(noisy[1][at])
    return [abs((after - before) - (float(second[at]) - offset_px))]
