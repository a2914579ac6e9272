"""What every calibration reader returns, and checked access to the fields of a file."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vergence_proto.errors import BadCalibration, BadPose
from vergence_proto.geometry import Matrix, Pose
from vergence_proto.types import Distortion, Intrinsics, StereoRig


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A rig as a file states it."""

    rig: StereoRig
    """The two cameras."""
    format: str
    """The name of the format that was recognised."""
    camera_time_offset_s: float | None = None
    """Seconds to add to the left camera's time stamps to get the time of the inertial sensor, as
    Kalibr's ``timeshift_cam_imu``; None if the file does not say."""


@dataclass(frozen=True, slots=True)
class Fields:
    """A mapping read from a file, with the place where it stands, for errors."""

    where: str
    """The file, and the keys that lead to the mapping."""
    values: Mapping[str, Any]

    @classmethod
    def of(cls, path: Path, read: object) -> "Fields":
        """Take what a file holds. Raises BadCalibration: it is no mapping."""
        if not isinstance(read, Mapping):
            raise BadCalibration(f"{path}: expected named values, got {type(read).__name__}")
        return cls(str(path), read)

    def __contains__(self, key: object) -> bool:
        return key in self.values

    def get(self, key: str) -> Any:
        """Return the value of a key. Raises BadCalibration: there is none."""
        if key not in self.values:
            found = ", ".join(map(str, self.values)) or "nothing"
            raise BadCalibration(f"{self.where}: expected {key!r}, found {found}")
        return self.values[key]

    def fields(self, key: str) -> "Fields":
        """Return the mapping under a key. Raises BadCalibration: there is none."""
        return self._fields(key, self.get(key))

    def items(self, key: str, count: int) -> list["Fields"]:
        """Return the mappings in the list under a key. Raises BadCalibration: too few of them."""
        values = self.get(key)
        if not isinstance(values, Sequence) or isinstance(values, str) or len(values) < count:
            raise BadCalibration(f"{self.where}, {key}: expected a list of at least {count}")
        return [self._fields(f"{key}[{index}]", value) for index, value in enumerate(values)]

    def array(self, key: str, shape: tuple[int, ...] | None = None) -> Matrix:
        """Return numbers as float64, of any nesting, in this shape or flat.

        Raises BadCalibration: there are none, or not as many as the shape has.
        """
        values = self.get(key)
        if isinstance(values, Mapping) and "data" in values:  # the matrices of ROS and EuRoC
            values = values["data"]
        try:
            numbers = np.asarray(values, np.float64).ravel()
        except (TypeError, ValueError):
            raise BadCalibration(f"{self.where}, {key}: expected numbers, got {values!r}") from None
        if shape is None:
            return numbers
        if numbers.size != np.prod(shape):
            raise BadCalibration(
                f"{self.where}, {key}: expected {np.prod(shape)} numbers, got {numbers.size}"
            )
        return numbers.reshape(shape)

    def number(self, key: str) -> float:
        """Return one number. Raises BadCalibration: there is none."""
        return float(self.array(key, (1,))[0])

    def pose(self, key: str) -> Pose:
        """Return a [4, 4] or [3, 4] matrix as a pose. Raises BadCalibration: it is none."""
        values = self.array(key)
        if values.size not in (12, 16):
            raise BadCalibration(f"{self.where}, {key}: expected a 4x4 matrix")
        try:
            return Pose.from_matrix(values.reshape(-1, 4))
        except BadPose as error:
            raise BadCalibration(f"{self.where}, {key}: {error}") from None

    def _fields(self, key: str, value: object) -> "Fields":
        if not isinstance(value, Mapping):
            raise BadCalibration(f"{self.where}, {key}: expected named values, got {value!r}")
        return Fields(f"{self.where}, {key}", value)


def intrinsics(
    where: str,
    size: Iterable[float],
    matrix: Iterable[float],
    model: Distortion,
    coefficients: Iterable[float],
) -> Intrinsics:
    """Make a camera of (width, height), (fx, fy, cx, cy) and the coefficients of a lens model.

    A Brown-Conrady lens whose coefficients are all zero has no distortion.
    Raises BadCalibration, with ``where``: a value cannot be.
    """
    values = tuple(map(float, coefficients))
    if model is Distortion.BROWN_CONRADY and not any(values):
        model, values = Distortion.NONE, ()
    width, height = (int(side) for side in size)
    fx, fy, cx, cy = map(float, matrix)
    try:
        return Intrinsics(width, height, fx, fy, cx, cy, model, values)
    except BadCalibration as error:
        raise BadCalibration(f"{where}: {error}") from None


def stereo_rig(where: str, left: Intrinsics, right: Intrinsics, left_from_right: Pose) -> StereoRig:
    """Make a rig. Raises BadCalibration, with ``where``: the two cameras are no stereo pair."""
    try:
        return StereoRig(left, right, left_from_right)
    except BadCalibration as error:
        raise BadCalibration(f"{where}: {error}") from None


def pose(where: str, rotation: Matrix, translation_m: Matrix) -> Pose:
    """Make a pose. Raises BadCalibration, with ``where``: the rotation is none."""
    try:
        return Pose.from_matrix(np.column_stack([rotation, translation_m]))
    except BadPose as error:
        raise BadCalibration(f"{where}: {error}") from None


def refused(where: str, what: str, known: Mapping[str, object], got: object) -> BadCalibration:
    """Return the error for a lens model that has no counterpart here."""
    return BadCalibration(
        f"{where}: expected the {what} {' or '.join(known)}, got {got!r}; calibrate with one of "
        "these models, or resample the images to a pinhole camera"
    )
