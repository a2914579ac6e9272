"""ROS: the CameraInfo of a left and a right camera.

``camera_calibration`` writes YAML with ``image_width`` and ``camera_matrix``; a printed message has
``width`` and ``k`` (ROS 1: ``K``). Only R and P state where the right camera is: ``P[3]`` of the
right one is ``-fx * baseline``. http://wiki.ros.org/image_pipeline/CameraInfo
"""

from collections.abc import Sequence

import numpy as np

from vergence_proto.calibration.parts import (
    Calibration,
    Fields,
    intrinsics,
    pose,
    refused,
    stereo_rig,
)
from vergence_proto.errors import BadCalibration
from vergence_proto.geometry import Matrix, Pose
from vergence_proto.types import Distortion, Intrinsics

_MODELS = {
    "plumb_bob": Distortion.BROWN_CONRADY,
    "rational_polynomial": Distortion.BROWN_CONRADY,
    "equidistant": Distortion.KANNALA_BRANDT,
    "fisheye": Distortion.KANNALA_BRANDT,
}
# The names of each field: of the YAML file, of ROS 2's message, of ROS 1's.
_WIDTH, _HEIGHT = ("image_width", "width"), ("image_height", "height")
_K, _D = ("camera_matrix", "k", "K"), ("distortion_coefficients", "d", "D")
_R, _P = ("rectification_matrix", "r", "R"), ("projection_matrix", "p", "P")


def is_camera_info(file: Fields) -> bool:
    """Return whether the file looks like one CameraInfo."""
    return all(any(name in file for name in names) for names in (_WIDTH, _K, _P))


def read(left_file: Fields, right_file: Fields) -> Calibration:
    """Read a pair. Raises BadCalibration."""
    left, right = _camera(left_file), _camera(right_file)
    left_p, right_p = (_field(file, _P, (3, 4)) for file in (left_file, right_file))
    baseline_m = left_p[0, 3] / left_p[0, 0] - right_p[0, 3] / right_p[0, 0]
    if not baseline_m > 0:
        raise BadCalibration(
            f"{right_file.where}: expected a right camera, whose P[3] is -fx * baseline in metres, "
            f"got P[3] = {right_p[0, 3]}; give the left camera's file first"
        )
    rectified_from_left, rectified_from_right = (
        Pose(_rotation(file), np.zeros(3)) for file in (left_file, right_file)
    )
    along = Pose(np.eye(3), np.array([baseline_m, 0.0, 0.0]))
    left_from_right = rectified_from_left.inverse() @ along @ rectified_from_right
    return Calibration(stereo_rig(right_file.where, left, right, left_from_right), "ros")


def _camera(file: Fields) -> Intrinsics:
    name = file.get("distortion_model")
    if name not in _MODELS:
        raise refused(file.where, "distortion_model", _MODELS, name)
    k = _field(file, _K, (3, 3))
    size = [_field(file, names, (1,))[0] for names in (_WIDTH, _HEIGHT)]
    coefficients: Sequence[float] = list(_field(file, _D, None))
    kind = _MODELS[name]
    if not coefficients:
        kind = Distortion.NONE
    return intrinsics(file.where, size, (k[0, 0], k[1, 1], k[0, 2], k[1, 2]), kind, coefficients)


def _rotation(file: Fields) -> Matrix:
    rotation = _field(file, _R, (3, 3))
    if not rotation.any():  # a driver that leaves R empty means a rectified camera
        return np.eye(3)
    return pose(file.where, rotation, np.zeros(3)).rotation


def _field(file: Fields, names: Sequence[str], shape: tuple[int, ...] | None) -> Matrix:
    name = next((name for name in names if name in file), names[0])
    return file.array(name, shape)
