"""Basalt: ``calibration.json``; everything stands under ``value0``.

``T_imu_cam`` maps camera to IMU coordinates. ``cam_time_offset_ns`` is the camera's delay.
https://gitlab.com/VladyslavUsenko/basalt/-/blob/master/doc/Calibration.md
"""

import numpy as np

from vergence_proto.calibration.parts import Calibration, Fields, intrinsics, refused, stereo_rig
from vergence_proto.errors import BadCalibration, BadPose
from vergence_proto.geometry import Pose
from vergence_proto.types import Distortion, Intrinsics

# The lens model of each camera_type, and the names of its coefficients in OpenCV's order.
_MODELS = {
    "pinhole": (Distortion.NONE, ()),
    "kb4": (Distortion.KANNALA_BRANDT, ("k1", "k2", "k3", "k4")),
    "pinhole-radtan8": (
        Distortion.BROWN_CONRADY,
        ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    ),
}


def read(file: Fields) -> Calibration:
    """Read the first two cameras, left and right. Raises BadCalibration."""
    top = file.fields("value0")
    cameras, sizes = top.items("intrinsics", 2), top.get("resolution")
    places = top.items("T_imu_cam", 2)
    if not isinstance(sizes, list) or len(sizes) < 2:
        raise BadCalibration(f"{top.where}, resolution: expected the sizes of two cameras")
    left, right = (_camera(cameras[i], np.ravel(sizes[i])) for i in (0, 1))
    imu_from_left, imu_from_right = (_pose(places[i]) for i in (0, 1))
    rig = stereo_rig(top.where, left, right, imu_from_left.inverse() @ imu_from_right)
    offset_ns = top.number("cam_time_offset_ns") if "cam_time_offset_ns" in top else None
    return Calibration(rig, "basalt", None if offset_ns is None else offset_ns * 1e-9)


def _camera(camera: Fields, size: np.ndarray) -> Intrinsics:
    kind = camera.get("camera_type")
    if kind not in _MODELS:
        raise refused(camera.where, "camera_type", _MODELS, kind)
    model, names = _MODELS[kind]
    numbers = camera.fields("intrinsics")
    matrix = [numbers.number(name) for name in ("fx", "fy", "cx", "cy")]
    return intrinsics(
        camera.where, size.tolist(), matrix, model, [numbers.number(name) for name in names]
    )


def _pose(place: Fields) -> Pose:
    xyzw = np.array([place.number(name) for name in ("qx", "qy", "qz", "qw")])
    translation_m = np.array([place.number(name) for name in ("px", "py", "pz")])
    try:
        return Pose.from_xyzw(xyzw, translation_m)
    except BadPose as error:
        raise BadCalibration(f"{place.where}: {error}") from None
