"""Depth at another pose: what a camera there would see, and nothing that nobody saw."""

import asyncio
import math
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.frames import RIG as FRAME_RIG
from tests.support.session_frames import step
from vergence import DepthClient, DepthResult, DepthView, OutputFormat, View, reproject
from vergence.depth_formats import d16, depth_from_d16, webxr
from vergence.recent import RecentResults
from vergence.reprojection import Fill
from vergence_proto.codec.steps import widen_plane
from vergence_proto.errors import BadCalibration, BadPose
from vergence_proto.geometry import Axes, Pose, RectifiedRig
from vergence_proto.types import ReceivedPlanes

RIG = RectifiedRig(96, 64, fx=70.0, fy=72.0, cx_left=46.0, cx_right=43.0, cy=33.0, baseline_m=0.1)
LEFT = View.like(RIG)
AT_REST = Pose.identity()
FILLS: tuple[Fill, ...] = ("far", "none")


def depth_of_plane(view: View, normal: np.ndarray, distance_m: float) -> np.ndarray:
    """Depth of the plane ``normal . p = distance_m`` in the camera of ``view``."""
    u, v = np.meshgrid(np.arange(view.width), np.arange(view.height))
    rays = np.stack([(u - view.cx) / view.fx, (v - view.cy) / view.fy, np.ones(u.shape)], -1)
    depth_m: np.ndarray = (distance_m / (rays @ normal)).astype(np.float32)
    return depth_m


def result_of(
    depth_m: np.ndarray, world_from_left: Pose | None = AT_REST, step: int = 1, **more: Any
) -> DepthResult:
    """A result as it arrives if every ``step``-th row and column was sent."""
    sent_px = RIG.disparity_from_depth(depth_m)[::step, ::step]
    return DepthResult(
        frame_id=7,
        capture_ns=10**9,
        rig=RIG,
        disparity_px=widen_plane(sent_px, step, (RIG.width, RIG.height)),
        world_from_left=world_from_left,
        raw=ReceivedPlanes(step, sent_px),
        **more,
    )


def moved(rotation_rad: list[float], translation_m: list[float]) -> Pose:
    x, y, z = rotation_rad
    quaternion = np.array([x / 2, y / 2, z / 2, 1.0])
    return Pose.from_xyzw(quaternion, np.array(translation_m))


def wall(depth_m: float) -> np.ndarray:
    return np.full((RIG.height, RIG.width), depth_m, np.float32)


def box_before_wall() -> np.ndarray:
    depth_m = wall(4.0)
    depth_m[20:44, 40:60] = 1.0
    return depth_m


small = st.floats(-0.12, 0.12)


@given(
    tilt=st.tuples(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4)),
    distance_m=st.floats(1.0, 8.0),
    rotation_rad=st.lists(small, min_size=3, max_size=3),
    translation_m=st.lists(small, min_size=3, max_size=3),
    zoom=st.floats(0.7, 1.4),
    step=st.sampled_from([1, 2]),
)
def test_a_plane_is_seen_where_it_is(
    tilt: tuple[float, float],
    distance_m: float,
    rotation_rad: list[float],
    translation_m: list[float],
    zoom: float,
    step: int,
) -> None:
    normal = np.array([*tilt, 1.0]) / np.linalg.norm([*tilt, 1.0])
    left_from_view = moved(rotation_rad, translation_m)
    view = View(120, 80, RIG.fx * zoom, RIG.fy * zoom, 60.0, 40.0)

    seen = reproject(
        result_of(depth_of_plane(LEFT, normal, distance_m), step=step), left_from_view, view
    )

    normal_in_view = left_from_view.rotation.T @ normal
    expected = depth_of_plane(
        view, normal_in_view, distance_m - float(normal @ left_from_view.translation_m)
    )
    assert seen.covered.any()
    # One pixel that was sent is up to 3 % of the depth of such a plane.
    np.testing.assert_allclose(
        seen.depth_m[seen.covered], expected[seen.covered], rtol=0.01 if step == 1 else 0.03
    )


@pytest.mark.parametrize("step", [1, 2])
def test_the_same_view_keeps_every_value(step: int) -> None:
    depth_m = box_before_wall()
    seen = reproject(result_of(depth_m, step=step), AT_REST)
    assert seen.covered.all()
    np.testing.assert_allclose(seen.depth_m, depth_m, rtol=1e-4)
    assert (seen.view, seen.frame_id, seen.age_s) == (LEFT, 7, 0.0)


@pytest.mark.parametrize("step", [1, 2])
def test_the_nearer_surface_wins_and_the_farther_fills(step: int) -> None:
    to_the_right = Pose(np.eye(3), np.array([0.3, 0.0, 0.0]))
    seen = reproject(result_of(box_before_wall(), step=step), to_the_right)
    # The box moves by 70 * 0.3 / 1 = 21 columns to the left, the wall by 5.25: what the box
    # covered before lies open behind it, and no result saw it.
    row = slice(24, 40)
    np.testing.assert_allclose(seen.depth_m[row, 21:37], 1.0, rtol=1e-3)
    assert seen.covered[row, 21:37].all()
    assert not seen.covered[row, 41:52].any()
    np.testing.assert_allclose(seen.depth_m[row, 41:52], 4.0, rtol=1e-3)

    honest = reproject(result_of(box_before_wall(), step=step), to_the_right, fill="none")
    assert np.isnan(honest.depth_m[~honest.covered]).all()
    np.testing.assert_array_equal(honest.covered, seen.covered)


@pytest.mark.parametrize("step", [1, 2])
def test_a_keyframe_shows_what_the_newest_result_does_not_see(step: int) -> None:
    to_the_right = Pose(np.eye(3), np.array([0.3, 0.0, 0.0]))
    hidden = wall(4.0)
    hidden[:, 70:] = 3.0  # seen from the keyframe alone
    keyframe = result_of(hidden, to_the_right, step=step)
    seen = reproject(result_of(box_before_wall(), step=step), to_the_right, keyframes=[keyframe])
    assert seen.covered.all()
    np.testing.assert_allclose(seen.depth_m[24:40, 41:52], 4.0, rtol=1e-3)
    np.testing.assert_allclose(seen.depth_m[:, 93:], 3.0, rtol=1e-3)
    np.testing.assert_allclose(seen.depth_m[24:40, 21:37], 1.0, rtol=1e-3)


@pytest.mark.parametrize("axes", Axes)
def test_axes_only_name_the_same_motion(axes: Axes) -> None:
    pose, target = moved([0.05, -0.1, 0.02], [0.1, 0.0, 0.2]), moved([0.0, 0.1, 0.0], [0, 0.1, 0.1])
    expected = reproject(result_of(box_before_wall(), pose), target)
    stated = result_of(box_before_wall(), axes.from_opencv(pose), axes=axes)
    seen = reproject(stated, axes.from_opencv(target))
    np.testing.assert_allclose(seen.depth_m, expected.depth_m, rtol=1e-3)


def test_sigma_grows_with_age_and_is_everything_where_nothing_was_seen() -> None:
    result = result_of(box_before_wall(), sigma_px=np.full((RIG.height, RIG.width), 0.1, "f4"))
    turned = Pose(np.eye(3), np.array([0.3, 0.0, 0.0]))
    ages_ns = (0, 10**8, 10**9)
    fresh, older, oldest = (
        reproject(result, turned, at_ns=result.capture_ns + age) for age in ages_ns
    )
    seen = fresh.covered
    assert fresh.sigma_m is not None
    assert older.sigma_m is not None
    assert oldest.sigma_m is not None
    assert (older.sigma_m[seen] > fresh.sigma_m[seen]).all()
    assert (oldest.sigma_m[seen] > older.sigma_m[seen]).all()
    np.testing.assert_array_equal(oldest.sigma_m[~seen], oldest.depth_m[~seen])
    assert oldest.age_s == 1.0
    # 0.1 px at 4 m is 0.1 * Z * Z / (f * b).
    own_m = 0.1 * 4.0**2 / (RIG.fx * RIG.baseline_m)
    np.testing.assert_allclose(fresh.sigma_m[2, 2], own_m, rtol=0.01)


@given(
    shape=st.tuples(st.integers(1, 40), st.integers(1, 40)),
    target=st.tuples(st.integers(1, 40), st.integers(1, 40)),
    seed=st.integers(0, 2**32 - 1),
    translation_m=st.lists(st.floats(-3, 3), min_size=3, max_size=3),
)
def test_any_map_gives_depth_or_nothing(
    shape: tuple[int, int], target: tuple[int, int], seed: int, translation_m: list[float]
) -> None:
    rng = np.random.default_rng(seed)
    disparity_px = rng.choice([np.nan, 0.0, -1.0, 1e-30, 0.5, 20.0, 1e30], shape).astype("f4")
    rig = RectifiedRig(shape[1], shape[0], 30.0, 30.0, 8.0, 8.0, 6.0, 0.1)
    result = DepthResult(1, 0, rig, disparity_px, world_from_left=AT_REST)
    view = View(target[1], target[0], 25.0, 25.0, 5.0, 5.0)
    halved = replace(result, raw=ReceivedPlanes(2, disparity_px[::2, ::2]))
    for fill, each in product(FILLS, (result, halved)):
        seen = reproject(each, Pose(np.eye(3), np.array(translation_m)), view, fill=fill)
        assert seen.depth_m.shape == seen.covered.shape == target
        assert not (seen.depth_m <= 0).any()
        assert np.isfinite(seen.depth_m[seen.covered]).all()


def test_a_result_without_a_pose_says_what_to_do() -> None:
    with pytest.raises(BadPose, match="submit frames with poses"):
        reproject(result_of(wall(2.0), None), AT_REST)


def test_a_pose_that_is_not_finite_is_refused() -> None:
    with pytest.raises(BadPose, match="finite"):
        reproject(result_of(wall(2.0)), Pose(np.eye(3), np.array([np.nan, 0, 0])))


def test_a_view_without_area_is_refused() -> None:
    for width, height in ((0, 4), (4, 0), (-1, 4), (10**6, 4)):
        with pytest.raises(BadCalibration, match="1x1"):
            View(width, height, 1.0, 1.0, 0.0, 0.0)
    with pytest.raises(BadCalibration, match="left < right"):
        View.from_fov(0.2, 0.2, 0.5, -0.5, width=8, height=8)
    with pytest.raises(BadCalibration, match="90 degrees"):
        View.from_fov(-0.2, np.pi / 2, 0.5, -0.5, width=8, height=8)
    with pytest.raises(BadCalibration, match="1x1"):
        View.from_fov(-0.2, 0.2, 0.5, -0.5, width=0, height=8)


def test_the_angles_of_a_view_reach_its_edges() -> None:
    view = View.from_fov(-0.7, 0.5, 0.4, -0.6, width=200, height=100)
    for edge, centre, focal, angle in (
        (-0.5, view.cx, view.fx, -0.7),
        (199.5, view.cx, view.fx, 0.5),
        (-0.5, view.cy, view.fy, -0.4),
        (99.5, view.cy, view.fy, 0.6),
    ):
        assert math.isclose(math.atan((edge - centre) / focal), angle, abs_tol=1e-9)


@given(far_m=st.sampled_from([math.inf, 20.0]), reversed_z=st.booleans(), bottom_up=st.booleans())
def test_a_16_bit_depth_buffer_gives_its_depth_back(
    far_m: float, reversed_z: bool, bottom_up: bool
) -> None:
    depth_m = np.geomspace(0.1, 15.0, 60, dtype=np.float32).reshape(6, 10)
    options: dict[str, bool] = {"reversed_z": reversed_z, "bottom_up": bottom_up}
    stored = d16(depth_m, 0.1, far_m, **options)
    back = depth_from_d16(stored, 0.1, far_m, **options)
    # Half a unit of 1 / 65535 in near / Z.
    assert (np.abs(1 / back - 1 / depth_m) <= 0.51 / 65535 / 0.1).all()
    nothing = d16(np.full((1, 1), np.nan, np.float32), 0.1, far_m, **options)
    assert nothing == (0 if reversed_z else 65535)


def test_a_depth_buffer_needs_planes_in_order() -> None:
    for near_m, far_m in ((0.0, 1.0), (2.0, 1.0), (math.inf, math.inf), (math.nan, 1.0)):
        with pytest.raises(ValueError, match="near_m"):
            d16(wall(1.0), near_m, far_m)


def test_webxr_depth_is_millimetres_and_zero_is_unknown() -> None:
    depth_m = np.array([[1.0, 65.535, 65.5361, np.nan, np.inf, 0.0]], np.float32)
    np.testing.assert_array_equal(webxr(depth_m), [[1000, 65535, 0, 0, 0, 0]])
    with pytest.raises(ValueError, match="positive"):
        webxr(depth_m, 0.0)


def test_a_view_exports_its_depth() -> None:
    seen = reproject(result_of(wall(2.0)), AT_REST)
    assert isinstance(seen, DepthView)
    np.testing.assert_allclose(depth_from_d16(seen.d16()), 2.0, rtol=1e-3)
    assert (seen.webxr() == 2000).all()


def at(capture_ns: int) -> DepthResult:
    return DepthResult(
        frame_id=capture_ns + 1,
        capture_ns=capture_ns,
        rig=RIG,
        disparity_px=RIG.disparity_from_depth(wall(2.0)),
        world_from_left=AT_REST,
    )


@given(gaps_ns=st.lists(st.integers(1, 400_000_000), min_size=1, max_size=200))
def test_a_session_keeps_a_handful_of_results_whatever_the_rate(gaps_ns: list[int]) -> None:
    recent, now_ns = RecentResults(), 0
    for gap_ns in gaps_ns:
        now_ns += gap_ns
        recent.add(at(now_ns))
        assert len(recent.kept) <= 6
        assert all(now_ns - each.capture_ns <= 1_300_000_000 for each in recent.kept)
    assert recent.latest is not None
    assert recent.latest.capture_ns == now_ns


async def test_a_session_shows_its_newest_result_from_any_thread(client: DepthClient) -> None:
    output = OutputFormat(sigma=True)
    async with client.open_session(FRAME_RIG, output=output, axes=Axes.OPENXR) as session:
        assert session.latest is None
        assert session.depth_at(AT_REST) is None
        result = await step(session, 3)
        assert session.latest is result
        pose = result.world_from_left
        assert pose is not None
        seen = await asyncio.to_thread(session.depth_at, pose, at_ns=result.capture_ns + 10**8)
        assert seen is not None
        np.testing.assert_allclose(seen.depth_m, result.depth_m, rtol=1e-3)
        assert seen.sigma_m is not None
        assert math.isclose(seen.age_s, 0.1)
        assert session.depth_at(pose, at_ns=result.capture_ns + 6 * 10**8) is None
        late = session.depth_at(pose.matrix, at_ns=result.capture_ns + 6 * 10**8, max_age_s=1)
        assert late is not None
