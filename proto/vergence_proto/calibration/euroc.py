"""EuRoC, TUM-VI and others in the ASL layout: ``cam0/sensor.yaml`` and ``cam1/sensor.yaml``.

``T_BS`` maps camera to body coordinates.
"""

from vergence_proto.calibration.parts import Calibration, Fields, intrinsics, refused, stereo_rig
from vergence_proto.types import Distortion, Intrinsics

_MODELS = {
    "radial-tangential": Distortion.BROWN_CONRADY,
    "equidistant": Distortion.KANNALA_BRANDT,
}


def is_sensor(file: Fields) -> bool:
    """Return whether the file looks like one sensor of the ASL layout."""
    return "T_BS" in file and "intrinsics" in file


def read(left_file: Fields, right_file: Fields) -> Calibration:
    """Read a pair. Raises BadCalibration."""
    left, right = _camera(left_file), _camera(right_file)
    left_from_right = left_file.pose("T_BS").inverse() @ right_file.pose("T_BS")
    return Calibration(stereo_rig(right_file.where, left, right, left_from_right), "euroc")


def _camera(file: Fields) -> Intrinsics:
    name = file.get("distortion_model")
    if name not in _MODELS:
        raise refused(file.where, "distortion_model", _MODELS, name)
    return intrinsics(
        file.where,
        file.array("resolution", (2,)),
        file.array("intrinsics", (4,)),
        _MODELS[name],
        file.array("distortion_coefficients"),
    )
