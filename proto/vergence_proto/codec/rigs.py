"""Poses, axes and rigs: conversion between messages and values."""

import numpy as np

from vergence_proto.codec.enums import AXES, DISTORTION, number_of, value_of
from vergence_proto.errors import BadCalibration, BadPose
from vergence_proto.geometry import Axes, Matrix, Pose, RectifiedRig
from vergence_proto.types import Intrinsics, PoseSample, StereoRig
from vergence_proto.v1 import depth_pb2 as pb

# Rounding to float32 and a few multiplications change a rotation by far less.
_UNIT_TOLERANCE = 1e-3


def axes_to_proto(axes: Axes) -> pb.Axes:
    return number_of(AXES, axes)


def axes_from_proto(axes: pb.Axes) -> Axes:
    """Decode; unspecified means OpenCV. Raises BadShape: depth.proto has no such number."""
    return value_of(AXES, axes, "axes")


def pose_to_proto(pose: Pose) -> pb.Pose:
    """Encode a pose. Raises BadPose: it is not finite, or its matrix is no rotation."""
    rotation = pose.rotation
    error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if not (error <= _UNIT_TOLERANCE and np.linalg.det(rotation) > 0):  # NaN fails here too
        raise BadPose(
            f"expected an orthonormal matrix of determinant +1, got {rotation.tolist()}; "
            "for left-handed poses, set the stream's axes instead of mirroring the matrix"
        )
    x, y, z, w = pose.orientation_xyzw
    orientation = pb.Quaternion(x=x, y=y, z=z, w=w)
    x, y, z = _finite(pose.translation_m, "position")
    return pb.Pose(orientation=orientation, position_m=pb.Vector3(x=x, y=y, z=z))


def pose_from_proto(message: pb.Pose) -> Pose:
    """Decode a pose.

    Raises BadPose: it is not finite, or the length of its quaternion is not 1 within 0.001.
    """
    return Pose.from_xyzw(_orientation_xyzw(message), _position_m(message))


def pose_sample_to_proto(sample: PoseSample) -> pb.PoseSample:
    """Encode a sample. Raises BadPose: its pose is not finite, or its matrix is no rotation."""
    return pb.PoseSample(
        world_from_left=pose_to_proto(sample.world_from_left),
        orientation_valid=sample.orientation_valid,
        position_valid=sample.position_valid,
        tracked=sample.tracked,
    )


def pose_sample_from_proto(message: pb.PoseSample) -> PoseSample:
    """Decode a sample. A part flagged invalid is undefined, as in OpenXR, and becomes the identity.

    Raises BadPose: a part flagged valid is not finite, or is no unit quaternion.
    """
    pose = message.world_from_left
    unknown = Pose.identity()
    world_from_left = Pose.from_xyzw(
        _orientation_xyzw(pose) if message.orientation_valid else unknown.orientation_xyzw,
        _position_m(pose) if message.position_valid else unknown.translation_m,
    )
    return PoseSample(
        world_from_left, message.orientation_valid, message.position_valid, message.tracked
    )


def rig_to_proto(rig: StereoRig) -> pb.StereoRig:
    """Encode a rig. Raises BadCalibration: ``left_from_right`` is no rigid transform."""
    try:
        left_from_right = pose_to_proto(rig.left_from_right)
    except BadPose as error:
        raise BadCalibration(f"left_from_right: {error}") from None
    return pb.StereoRig(
        left=_camera_to_proto(rig.left),
        right=_camera_to_proto(rig.right),
        left_from_right=left_from_right,
    )


def rig_from_proto(message: pb.StereoRig) -> StereoRig:
    """Decode a rig.

    Raises BadCalibration: a part is missing, a camera's intrinsics are invalid, or the rig cannot
    be used for stereo.
    """
    for part in ("left", "right", "left_from_right"):
        if not message.HasField(part):
            raise BadCalibration(f"the rig has no {part}; send both cameras and left_from_right")
    try:
        left_from_right = pose_from_proto(message.left_from_right)
    except BadPose as error:
        raise BadCalibration(f"left_from_right: {error}") from None
    return StereoRig(
        _camera_from_proto(message.left, "left"),
        _camera_from_proto(message.right, "right"),
        left_from_right,
    )


def rectified_rig_to_proto(rig: RectifiedRig) -> pb.RectifiedRig:
    return pb.RectifiedRig(
        width=rig.width,
        height=rig.height,
        fx=rig.fx,
        fy=rig.fy,
        cx_left=rig.cx_left,
        cx_right=rig.cx_right,
        cy=rig.cy,
        baseline_m=rig.baseline_m,
    )


def rectified_rig_from_proto(message: pb.RectifiedRig) -> RectifiedRig:
    """Decode a rig.

    Raises BadCalibration: a size, focal length or the baseline is not a positive number.
    """
    rig = RectifiedRig(
        message.width,
        message.height,
        message.fx,
        message.fy,
        message.cx_left,
        message.cx_right,
        message.cy,
        message.baseline_m,
    )
    StereoRig.from_rectified(rig)  # checks the values
    if rig.baseline_m < 0:
        raise BadCalibration(f"the baseline must be positive metres, got {rig.baseline_m}")
    return rig


def _camera_to_proto(camera: Intrinsics) -> pb.Camera:
    return pb.Camera(
        width=camera.width,
        height=camera.height,
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
        distortion=number_of(DISTORTION, camera.distortion),
        coefficients=camera.coefficients,
    )


def _camera_from_proto(message: pb.Camera, side: str) -> Intrinsics:
    distortion = value_of(
        DISTORTION, message.distortion, f"{side} camera's distortion", BadCalibration
    )
    try:
        return Intrinsics(
            message.width,
            message.height,
            message.fx,
            message.fy,
            message.cx,
            message.cy,
            distortion,
            tuple(message.coefficients),
        )
    except BadCalibration as error:
        raise BadCalibration(f"{side} camera: {error}") from None


def _orientation_xyzw(message: pb.Pose) -> Matrix:
    q = message.orientation
    orientation_xyzw = _finite([q.x, q.y, q.z, q.w], "orientation")
    with np.errstate(over="ignore"):
        length = float(np.linalg.norm(orientation_xyzw))
    if abs(length - 1) > _UNIT_TOLERANCE:
        raise BadPose(
            f"expected a unit quaternion x y z w, got {orientation_xyzw.tolist()} "
            f"of length {length:.6g}; normalise it, or flag the orientation invalid"
        )
    return orientation_xyzw


def _position_m(message: pb.Pose) -> Matrix:
    p = message.position_m
    return _finite([p.x, p.y, p.z], "position")


def _finite(numbers: list[float] | Matrix, part: str) -> Matrix:
    array = np.asarray(numbers, np.float64)
    if not np.isfinite(array).all():
        raise BadPose(
            f"expected a finite {part}, got {array.tolist()}; "
            "if tracking is lost, send the pose with its valid flags off"
        )
    return array
