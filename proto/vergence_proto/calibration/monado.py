"""Monado: the calibration JSON of version 2, as its tools write it.

``opencv_stereo_calibrate`` has OpenCV's R and T: ``x_right = R @ x_left + T``, in metres.
https://monado.pages.freedesktop.org/monado/calibration_v2.schema.json
"""

from vergence_proto.calibration.parts import (
    Calibration,
    Fields,
    intrinsics,
    pose,
    refused,
    stereo_rig,
)
from vergence_proto.types import Distortion, Intrinsics

# The lens model of each name, and its coefficients in OpenCV's order.
_MODELS = {
    "pinhole_radtan5": (Distortion.BROWN_CONRADY, ("k1", "k2", "p1", "p2", "k3")),
    "pinhole_radtan8": (
        Distortion.BROWN_CONRADY,
        ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    ),
    "fisheye_equidistant4": (Distortion.KANNALA_BRANDT, ("k1", "k2", "k3", "k4")),
}


def read(file: Fields) -> Calibration:
    """Read the first two cameras, left and right. Raises BadCalibration."""
    left, right = (_camera(camera) for camera in file.items("cameras", 2)[:2])
    stereo = file.fields("opencv_stereo_calibrate")
    right_from_left = pose(
        stereo.where, stereo.array("rotation", (3, 3)), stereo.array("translation", (3,))
    )
    rig = stereo_rig(file.where, left, right, right_from_left.inverse())
    return Calibration(rig, "monado")


def _camera(camera: Fields) -> Intrinsics:
    kind = camera.get("model")
    if kind not in _MODELS:
        raise refused(camera.where, "model", _MODELS, kind)
    model, names = _MODELS[kind]
    matrix, distortion = camera.fields("intrinsics"), camera.fields("distortion")
    size = camera.fields("resolution")
    return intrinsics(
        camera.where,
        [size.number("width"), size.number("height")],
        [matrix.number(name) for name in ("fx", "fy", "cx", "cy")],
        model,
        [distortion.number(name) for name in names],
    )
