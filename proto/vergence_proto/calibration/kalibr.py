"""Kalibr: ``camchain.yaml`` and ``camchain-imucam.yaml``.

``T_cn_cnm1`` of cam1 maps coordinates of cam0 to cam1. ``timeshift_cam_imu`` is in seconds:
``t_imu = t_cam + shift``. https://github.com/ethz-asl/kalibr/wiki/yaml-formats
"""

from vergence_proto.calibration.parts import (
    Calibration,
    Fields,
    intrinsics,
    refused,
    stereo_rig,
)
from vergence_proto.types import Distortion, Intrinsics

_DISTORTIONS = {
    "radtan": Distortion.BROWN_CONRADY,
    "equidistant": Distortion.KANNALA_BRANDT,
    "none": Distortion.NONE,
}


def read(file: Fields) -> Calibration:
    """Read the pair cam0 (left) and cam1. Raises BadCalibration."""
    left, right = (_camera(file.fields(name)) for name in ("cam0", "cam1"))
    right_from_left = file.fields("cam1").pose("T_cn_cnm1")
    rig = stereo_rig(file.where, left, right, right_from_left.inverse())
    shift = file.fields("cam0")
    offset_s = shift.number("timeshift_cam_imu") if "timeshift_cam_imu" in shift else None
    return Calibration(rig, "kalibr", offset_s)


def _camera(camera: Fields) -> Intrinsics:
    model = camera.get("camera_model")
    if model != "pinhole":
        raise refused(camera.where, "camera_model", {"pinhole": None}, model)
    distortion = camera.get("distortion_model") if "distortion_model" in camera else "none"
    if distortion not in _DISTORTIONS:
        raise refused(camera.where, "distortion_model", _DISTORTIONS, distortion)
    kind = _DISTORTIONS[distortion]
    coefficients = () if kind is Distortion.NONE else camera.array("distortion_coeffs")
    return intrinsics(
        camera.where,
        camera.array("resolution", (2,)),
        camera.array("intrinsics", (4,)),
        kind,
        coefficients,
    )
