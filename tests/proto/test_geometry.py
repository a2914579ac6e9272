import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.strategies import (
    ANGLES,
    DIRECTIONS,
    POSES,
    POSITIONS,
    RIGS,
    SMALL_POSES,
    assert_same_pose,
    rotation_about,
)
from vergence_proto.geometry import Axes, Matrix, Pose, RectifiedRig, uvd_curr_from_prev

ROUNDING_M = 1e-12  # a few multiplications of numbers up to 100 in float64
# The transform is handed over in float32: 24 bits of coordinates up to a thousand, amplified by
# points that come close to the camera.
FLOAT32_PX = 2e-2
CONVENTIONS = [pytest.param(axes, id=axes.name) for axes in Axes]


class TestPosesAreAGroup:
    @given(POSES, POSES, POSES)
    def test_composition_is_associative(self, a: Pose, b: Pose, c: Pose) -> None:
        assert_same_pose((a @ b) @ c, a @ (b @ c), ROUNDING_M)

    @given(POSES)
    def test_identity_changes_nothing_on_either_side(self, a: Pose) -> None:
        assert_same_pose(a @ Pose.identity(), a)
        assert_same_pose(Pose.identity() @ a, a)

    @given(POSES)
    def test_inverse_undoes_on_both_sides(self, a: Pose) -> None:
        assert_same_pose(a @ a.inverse(), Pose.identity(), ROUNDING_M)
        assert_same_pose(a.inverse() @ a, Pose.identity(), ROUNDING_M)

    @given(POSES, POSES, POSITIONS)
    def test_composed_motion_maps_points_like_one_after_the_other(
        self, a_from_b: Pose, b_from_c: Pose, point_c: Matrix
    ) -> None:
        direct = (a_from_b @ b_from_c).apply(point_c)
        np.testing.assert_allclose(direct, a_from_b.apply(b_from_c.apply(point_c)), atol=ROUNDING_M)

    @given(POSES, POSES)
    def test_it_is_the_product_of_homogeneous_matrices(self, a: Pose, b: Pose) -> None:
        np.testing.assert_allclose((a @ b).matrix, a.matrix @ b.matrix, rtol=0, atol=ROUNDING_M)
        assert_same_pose(Pose.from_matrix(a.matrix), a)


class TestQuaternions:
    @given(POSES)
    def test_round_trip_keeps_the_rotation(self, pose: Pose) -> None:
        back = Pose.from_xyzw(pose.orientation_xyzw, pose.translation_m)
        assert_same_pose(back, pose, ROUNDING_M)

    @given(DIRECTIONS, ANGLES)
    def test_is_sine_and_cosine_of_half_the_angle(
        self, direction: tuple[float, ...], angle: float
    ) -> None:
        axis = np.array(direction) / np.linalg.norm(direction)
        expected = np.array([*axis * np.sin(angle / 2), np.cos(angle / 2)])
        actual = Pose(rotation_about(direction, angle), np.zeros(3)).orientation_xyzw
        sign = np.sign(actual @ expected)  # q and -q are one rotation
        np.testing.assert_allclose(actual, sign * expected, rtol=0, atol=ROUNDING_M)
        assert actual[3] >= 0

    @given(POSES, st.floats(0.1, 10), st.sampled_from([1, -1]))
    def test_sign_and_length_do_not_matter(self, pose: Pose, length: float, sign: int) -> None:
        scaled = sign * length * pose.orientation_xyzw
        assert_same_pose(Pose.from_xyzw(scaled, pose.translation_m), pose, ROUNDING_M)

    @pytest.mark.parametrize("largest", range(4), ids="xyzw")
    def test_each_component_may_be_the_largest(self, largest: int) -> None:
        expected = np.full(4, 0.2)
        expected[largest] = np.sqrt(1 - 3 * 0.2**2)
        actual = Pose.from_xyzw(expected, np.zeros(3)).orientation_xyzw
        np.testing.assert_allclose(actual, expected, atol=ROUNDING_M)

    def test_a_quarter_turn_about_z_takes_x_to_y(self) -> None:
        pose = Pose.from_xyzw(np.array([0, 0, np.sqrt(0.5), np.sqrt(0.5)]), np.zeros(3))
        np.testing.assert_allclose(pose.apply(np.array([1.0, 0, 0])), [0, 1, 0], atol=ROUNDING_M)


class TestAxes:
    @pytest.mark.parametrize("axes", CONVENTIONS)
    @given(pose=POSES)
    def test_there_and_back_is_the_same_pose(self, axes: Axes, pose: Pose) -> None:
        assert_same_pose(axes.from_opencv(axes.to_opencv(pose)), pose)
        assert_same_pose(axes.to_opencv(axes.from_opencv(pose)), pose)

    @pytest.mark.parametrize("axes", CONVENTIONS)
    @given(pose=POSES)
    def test_a_rotation_stays_a_rotation(self, axes: Axes, pose: Pose) -> None:
        rotation = axes.to_opencv(pose).rotation
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=ROUNDING_M)
        assert np.linalg.det(rotation) == pytest.approx(1)

    @pytest.mark.parametrize("axes", CONVENTIONS)
    @given(a=POSES, b=POSES)
    def test_motions_compose_alike_in_every_convention(self, axes: Axes, a: Pose, b: Pose) -> None:
        assert_same_pose(axes.to_opencv(a @ b), axes.to_opencv(a) @ axes.to_opencv(b), ROUNDING_M)

    @pytest.mark.parametrize(
        ("axes", "right_1_up_2_forward_3_m"),
        [
            pytest.param(Axes.OPENCV, (1, -2, 3), id="x right, y down, z forward"),
            pytest.param(Axes.OPENXR, (1, 2, -3), id="x right, y up, z back"),
            pytest.param(Axes.UNITY, (1, 2, 3), id="x right, y up, z forward"),
            pytest.param(Axes.NED, (3, 1, -2), id="x forward, y right, z down"),
            pytest.param(Axes.ROS, (3, -1, 2), id="x forward, y left, z up"),
        ],
    )
    def test_the_same_place_in_each_convention(
        self, axes: Axes, right_1_up_2_forward_3_m: tuple[int, ...]
    ) -> None:
        pose = Pose(np.eye(3), np.array(right_1_up_2_forward_3_m, np.float64))
        np.testing.assert_array_equal(axes.to_opencv(pose).translation_m, [1, -2, 3])

    @pytest.mark.parametrize(
        ("axes", "xyz", "looks"),
        [
            # OpenCV, right-handed, y down: about +y turns right.
            pytest.param(Axes.OPENCV, (0, 1, 0), (1, 0, 0), id="opencv about y: right"),
            # OpenXR, right-handed, y up: about +y turns left; about +x looks up.
            pytest.param(Axes.OPENXR, (0, 1, 0), (-1, 0, 0), id="openxr about y: left"),
            pytest.param(Axes.OPENXR, (1, 0, 0), (0, -1, 0), id="openxr about x: up"),
            # Unity, left-handed: about +y turns right; about +x looks down.
            pytest.param(Axes.UNITY, (0, 1, 0), (1, 0, 0), id="unity about y: right"),
            pytest.param(Axes.UNITY, (1, 0, 0), (0, 1, 0), id="unity about x: down"),
            # North east down: about +z (yaw) turns right; about +y (pitch) looks up.
            pytest.param(Axes.NED, (0, 0, 1), (1, 0, 0), id="ned about z: right"),
            pytest.param(Axes.NED, (0, 1, 0), (0, -1, 0), id="ned about y: up"),
            # REP 103, right-handed, z up: about +z (yaw) turns left; about +y (pitch) looks down.
            pytest.param(Axes.ROS, (0, 0, 1), (-1, 0, 0), id="ros about z: left"),
            pytest.param(Axes.ROS, (0, 1, 0), (0, 1, 0), id="ros about y: down"),
        ],
    )
    def test_where_a_quarter_turn_looks(
        self, axes: Axes, xyz: tuple[int, ...], looks: tuple[int, ...]
    ) -> None:
        quarter = np.array([*np.array(xyz) * np.sqrt(0.5), np.sqrt(0.5)])
        pose = axes.to_opencv(Pose.from_xyzw(quarter, np.zeros(3)))
        forward = np.array([0.0, 0, 1])
        np.testing.assert_allclose(pose.apply(forward), looks, atol=ROUNDING_M)


class TestDisparityAndDepth:
    @given(RIGS, st.floats(0.2, 100))
    def test_depth_is_the_inverse_of_disparity(self, rig: RectifiedRig, depth_m: float) -> None:
        depth = np.full((1, 1), depth_m, np.float32)
        disparity_px = rig.disparity_from_depth(depth)
        np.testing.assert_allclose(disparity_px, rig.fx * rig.baseline_m / depth_m, rtol=1e-6)
        np.testing.assert_allclose(rig.depth_from_disparity(disparity_px), depth, rtol=1e-6)

    @given(RIGS, st.sampled_from([0.0, -1.0, np.nan, -np.inf]))
    def test_no_positive_disparity_no_depth(self, rig: RectifiedRig, value: float) -> None:
        assert np.isnan(rig.depth_from_disparity(np.full((2, 2), value, np.float32))).all()

    @given(RIGS, st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(0.3, 50)))
    def test_q_unprojects_what_the_two_cameras_see(
        self, rig: RectifiedRig, point: tuple[float, float, float]
    ) -> None:
        xyzw = rig.xyzw_from_uvd @ [*_project(rig, np.array(point)), 1]
        np.testing.assert_allclose(xyzw[:3] / xyzw[3], point, rtol=1e-9, atol=1e-9)


def _project(rig: RectifiedRig, point_m: Matrix) -> Matrix:
    """(u, v, u_left - u_right) of a point in left-camera metres, each camera by itself."""
    x, y, z = point_m
    u_left = rig.fx * x / z + rig.cx_left
    u_right = rig.fx * (x - rig.baseline_m) / z + rig.cx_right
    return np.array([u_left, rig.fy * y / z + rig.cy, u_left - u_right])


@given(
    RIGS,
    RIGS,
    SMALL_POSES,
    st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(1.5, 50)),
)
def test_the_warp_in_disparity_space_is_the_motion_of_points(
    rig: RectifiedRig,
    prev_rig: RectifiedRig,
    curr_from_prev: Pose,
    point_prev: tuple[float, float, float],
) -> None:
    point = np.array(point_prev)
    for before in (rig, prev_rig):
        transform = uvd_curr_from_prev(rig, curr_from_prev, before)
        assert transform.dtype == np.float32
        moved = transform.astype(np.float64) @ [*_project(before, point), 1]
        expected = _project(rig, curr_from_prev.rotation @ point + curr_from_prev.translation_m)
        np.testing.assert_allclose(moved[:3] / moved[3], expected, rtol=1e-5, atol=FLOAT32_PX)


def test_the_previous_rig_is_the_same_one_unless_given() -> None:
    rig = RectifiedRig(640, 480, 400, 410, 320, 300, 240, 0.1)
    motion = Pose(rotation_about((0, 1, 0), 0.1), np.array([0.1, 0, 0.2]))
    np.testing.assert_array_equal(
        uvd_curr_from_prev(rig, motion), uvd_curr_from_prev(rig, motion, rig)
    )


def test_standing_still_moves_no_pixel() -> None:
    rig = RectifiedRig(640, 480, 400, 410, 320, 300, 240, 0.1)
    np.testing.assert_allclose(uvd_curr_from_prev(rig, Pose.identity()), np.eye(4), atol=1e-12)
