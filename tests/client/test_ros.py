"""Results as ROS messages: the numbers that a ROS program computes from them are ours."""

import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vergence import Axes, BadPose, DepthResult, Pose, RectifiedRig, ros

RIG = RectifiedRig(6, 4, fx=70.0, fy=72.0, cx_left=3.5, cx_right=2.0, cy=1.5, baseline_m=0.1)


def result_with(disparity_px: np.ndarray, **more: Any) -> DepthResult:
    return DepthResult(3, 1_500_000_000, RIG, disparity_px.astype(np.float32), **more)


def ramp() -> np.ndarray:
    disparity_px = np.linspace(0.5, 12.0, 24).reshape(4, 6)
    disparity_px[1, 2] = np.nan
    return disparity_px


def pixels(image: ros.Message, kind: type) -> np.ndarray:
    assert image["is_bigendian"] == (sys.byteorder == "big")
    assert image["step"] == image["width"] * np.dtype(kind).itemsize
    return np.frombuffer(image["data"], kind).reshape(image["height"], image["width"])


def test_a_depth_image_is_metres_or_millimetres() -> None:
    result = result_with(ramp())
    metres = ros.depth_image(result, frame_id="left_optical")
    np.testing.assert_array_equal(pixels(metres, np.float32), result.depth_m)
    assert metres["header"] == {
        "stamp": {"sec": 1, "nanosec": 500_000_000},
        "frame_id": "left_optical",
    }
    millimetres = ros.depth_image(result, frame_id="l", encoding="16UC1", stamp_ns=7)
    stored = pixels(millimetres, np.uint16)
    assert stored[1, 2] == 0
    seen = stored > 0
    np.testing.assert_allclose(stored[seen] / 1000, result.depth_m[seen], atol=0.00051)
    assert millimetres["header"]["stamp"] == {"sec": 0, "nanosec": 7}


@given(cx_right=st.floats(-20, 20))
def test_a_disparity_image_gives_the_depth_by_the_formula_of_ros(cx_right: float) -> None:
    rig = RectifiedRig(6, 4, 70.0, 72.0, 3.5, cx_right, 1.5, 0.1)
    result = DepthResult(3, 0, rig, ramp().astype(np.float32))
    message = ros.disparity_image(result, frame_id="l")
    left, right = (
        ros.camera_info(rig, frame_id="l", stamp_ns=0, side=side) for side in ("left", "right")
    )
    disparity = pixels(message["image"], np.float32)
    known = disparity >= message["min_disparity"]
    np.testing.assert_array_equal(known, result.valid)
    assert disparity.max() <= message["max_disparity"]
    # image_geometry's StereoCameraModel: Z = -P_right[3] / (d - (cx_left - cx_right)).
    depth_m = -right["p"][3] / (disparity - (left["p"][2] - right["p"][2]))
    np.testing.assert_allclose(depth_m[known], result.depth_m[known], rtol=1e-3)
    assert message["f"] * message["t"] == -right["p"][3]


def test_points_project_to_their_pixels_in_any_axes() -> None:
    pose = Pose.from_xyzw(np.array([0.1, 0.2, -0.1, 1.0]), np.array([1.0, 2.0, 3.0]))
    expected = result_with(ramp(), world_from_left=pose).points_m(world=True)
    for axes in Axes:
        stated = result_with(ramp(), world_from_left=axes.from_opencv(pose), axes=axes)
        opencv_from_axes = np.array(axes.value, np.float64)
        in_camera = stated.points_m() @ opencv_from_axes.T
        v, u = np.nonzero(stated.valid)
        x, y, z = in_camera[v, u].T
        np.testing.assert_allclose(x / z * RIG.fx + RIG.cx_left, u, atol=1e-4)
        np.testing.assert_allclose(y / z * RIG.fy + RIG.cy, v, atol=1e-4)
        np.testing.assert_allclose(z, stated.depth_m[v, u], rtol=1e-6)
        assert np.isnan(in_camera[1, 2]).all()
        world = stated.points_m(world=True) @ opencv_from_axes.T
        np.testing.assert_allclose(world, expected, rtol=1e-4)


def test_points_of_the_world_need_a_pose() -> None:
    with pytest.raises(BadPose, match="submit frames with poses"):
        result_with(ramp()).points_m(world=True)
