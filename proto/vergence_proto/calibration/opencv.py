"""OpenCV: what ``cv2.FileStorage`` wrote after stereoCalibrate or stereoRectify.

OpenCV gives the matrices no fixed names. These are read, as its samples and tutorials write them:
``M1 D1 M2 D2`` (or ``K1``, ``cameraMatrix1``, ``distCoeffs1``), ``R`` and ``T`` with
``x_right = R @ x_left + T``. A file of a rectified pair may have ``P1`` and ``P2`` alone. The
lengths of T are in the units of the chessboard's squares, which the file does not state, and older
files lack the image size too.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from vergence_proto.calibration.parts import Calibration, Fields, intrinsics, pose, stereo_rig
from vergence_proto.errors import BadCalibration
from vergence_proto.geometry import Matrix, Pose
from vergence_proto.types import Distortion, Intrinsics

_MATRIX = ("M{}", "K{}", "cameraMatrix{}", "camera_matrix_{}", "CM{}")
_COEFFICIENTS = ("D{}", "distCoeffs{}", "dist_coeffs_{}", "distortion_coefficients_{}")
_COUNTS = (4, 5, 8, 12, 14)
# A baseline in these units would be longer than any rig's in metres.
_LONGEST_BASELINE_M = 5.0


def has_matrices(values: Mapping[str, object]) -> bool:
    """Return whether the values look like those of a stereo calibration."""
    return any(name.format(1) in values for name in (*_MATRIX, "P1"))


def read(file: Fields, size: tuple[int, int] | None, unit_m: float) -> Calibration:
    """Read a calibration; ``unit_m`` is the length in metres of the unit that T is stated in.

    Raises BadCalibration: a matrix is missing, or the size or the unit has to be given.
    """
    width_height = _size(file, size)
    if not any(name.format(1) in file for name in _MATRIX):
        return _rectified(file, width_height, unit_m)
    left, right = (_camera(file, number, width_height) for number in "12")
    translation = file.array("T", (3,)) * unit_m
    _check_unit(file, float(np.linalg.norm(translation)))
    right_from_left = pose(file.where, file.array("R", (3, 3)), translation)
    return Calibration(stereo_rig(file.where, left, right, right_from_left.inverse()), "opencv")


def _rectified(file: Fields, size: Sequence[float], unit_m: float) -> Calibration:
    left, right = (file.array(name, (3, 4)) for name in ("P1", "P2"))
    baseline_m = -right[0, 3] / right[0, 0] * unit_m
    _check_unit(file, baseline_m)
    left_camera, right_camera = (
        intrinsics(file.where, size, (p[0, 0], p[1, 1], p[0, 2], p[1, 2]), Distortion.NONE, ())
        for p in (left, right)
    )
    left_from_right = Pose(np.eye(3), np.array([baseline_m, 0.0, 0.0]))
    rig = stereo_rig(file.where, left_camera, right_camera, left_from_right)
    return Calibration(rig, "opencv")


def _camera(file: Fields, number: str, size: Sequence[float]) -> Intrinsics:
    matrix = _named(file, _MATRIX, number, (3, 3))
    coefficients = _named(file, _COEFFICIENTS, number, None)
    # OpenCV pads to 14 with zeros.
    count = next((count for count in _COUNTS if not coefficients[count:].any()), _COUNTS[-1])
    values = np.zeros(count)
    values[: min(count, coefficients.size)] = coefficients[:count]
    return intrinsics(
        file.where,
        size,
        (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]),
        Distortion.BROWN_CONRADY,
        values,
    )


def _named(
    file: Fields, names: Sequence[str], number: str, shape: tuple[int, ...] | None
) -> Matrix:
    known = [name.format(number) for name in names]
    return file.array(next((name for name in known if name in file), known[0]), shape)


def _size(file: Fields, size: tuple[int, int] | None) -> Sequence[float]:
    for width, height in (("image_width", "image_height"), ("width", "height")):
        if width in file and height in file:
            return file.number(width), file.number(height)
    for key in ("image_size", "imageSize", "size"):
        if key in file:
            return [float(side) for side in file.array(key, (2,))]
    if size is None:
        raise BadCalibration(
            f"{file.where}: the file does not say the size of the images; state it, as in "
            "StereoRig.load(path, size=(640, 480)) or vergence calib --size 640x480"
        )
    return size


def _check_unit(file: Fields, baseline_m: float) -> None:
    if baseline_m > _LONGEST_BASELINE_M:
        raise BadCalibration(
            f"{file.where}: a baseline of {baseline_m:g} m is not plausible; OpenCV's lengths are "
            "in the units of the chessboard: state them, as in StereoRig.load(path, unit_m=0.001) "
            "or vergence calib --unit-m 0.001 for millimetres"
        )
