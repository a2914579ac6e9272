"""Our own calibration file: JSON, with the fields of :class:`~vergence_proto.types.StereoRig`.

::

    {"format": "vergence-rig", "version": 1,
     "left": {"width", "height", "fx", "fy", "cx", "cy", "distortion", "coefficients"},
     "right": the same,
     "left_from_right": [[...], [...], [...], [...]]}      4x4, metres, OpenCV axes
"""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from vergence_proto.calibration.parts import Calibration, Fields, intrinsics, refused, stereo_rig
from vergence_proto.errors import BadCalibration
from vergence_proto.types import Distortion, Intrinsics, StereoRig

FORMAT = "vergence-rig"
_VERSION = 1
_MODELS = {model.value: model for model in Distortion}


def read(file: Fields) -> Calibration:
    """Read a rig. Raises BadCalibration."""
    if file.number("version") > _VERSION:
        raise BadCalibration(
            f"{file.where}: expected version {_VERSION}, got {file.get('version')}; "
            "it was written by a newer version of this program"
        )
    left, right = (_camera(file.fields(name)) for name in ("left", "right"))
    rig = stereo_rig(file.where, left, right, file.pose("left_from_right"))
    return Calibration(rig, "vergence")


def write_rig(path: Path, rig: StereoRig) -> None:
    """Write a rig as JSON, exact to the last bit."""
    values = {
        "format": FORMAT,
        "version": _VERSION,
        "left": _values(rig.left),
        "right": _values(rig.right),
        "left_from_right": rig.left_from_right.matrix.tolist(),
    }
    path.write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")


def _values(camera: Intrinsics) -> dict[str, Any]:
    return {**asdict(camera), "distortion": camera.distortion.value}


def _camera(camera: Fields) -> Intrinsics:
    name = camera.get("distortion")
    if name not in _MODELS:
        raise refused(camera.where, "distortion", _MODELS, name)
    return intrinsics(
        camera.where,
        [camera.number("width"), camera.number("height")],
        [camera.number(key) for key in ("fx", "fy", "cx", "cy")],
        _MODELS[name],
        camera.array("coefficients"),
    )
