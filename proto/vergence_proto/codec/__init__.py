"""Conversion between wire messages and values, and the only check of received data.

Every value that a ``..._from_proto`` function returns satisfies :mod:`vergence_proto.types`.
Invalid data raises the :class:`~vergence_proto.errors.DepthError` that states what was expected and
what came. The layers below the codec do not check again.
"""

from vergence_proto.codec.frames import (
    check_frame,
    decode_frame,
    delivery_from_proto,
    delivery_to_proto,
    disparity_from_proto,
    disparity_to_proto,
    error_from_frame_error,
    error_to_frame_error,
    frame_from_proto,
    frame_to_request,
    origin_from_proto,
    origin_to_proto,
    output_format_from_proto,
    output_format_to_proto,
    received_planes_from_proto,
    timings_from_proto,
    timings_to_proto,
)
from vergence_proto.codec.images import (
    camera_file,
    check_image,
    image_from_proto,
    image_to_wire,
)
from vergence_proto.codec.planes import plane_from_proto, plane_to_proto
from vergence_proto.codec.requests import (
    ReceivedFrame,
    Request,
    read_frame,
    read_request,
    read_small,
)
from vergence_proto.codec.rigs import (
    axes_from_proto,
    axes_to_proto,
    pose_from_proto,
    pose_sample_from_proto,
    pose_sample_to_proto,
    pose_to_proto,
    rectified_rig_from_proto,
    rectified_rig_to_proto,
    rig_from_proto,
    rig_to_proto,
)
from vergence_proto.codec.status import error_from_status, error_to_status
from vergence_proto.codec.steps import MAX_FRAME_SCALE, reduced

__all__ = [
    "MAX_FRAME_SCALE",
    "ReceivedFrame",
    "Request",
    "axes_from_proto",
    "axes_to_proto",
    "camera_file",
    "check_frame",
    "check_image",
    "decode_frame",
    "delivery_from_proto",
    "delivery_to_proto",
    "disparity_from_proto",
    "disparity_to_proto",
    "error_from_frame_error",
    "error_from_status",
    "error_to_frame_error",
    "error_to_status",
    "frame_from_proto",
    "frame_to_request",
    "image_from_proto",
    "image_to_wire",
    "origin_from_proto",
    "origin_to_proto",
    "output_format_from_proto",
    "output_format_to_proto",
    "plane_from_proto",
    "plane_to_proto",
    "pose_from_proto",
    "pose_sample_from_proto",
    "pose_sample_to_proto",
    "pose_to_proto",
    "read_frame",
    "read_request",
    "read_small",
    "received_planes_from_proto",
    "rectified_rig_from_proto",
    "rectified_rig_to_proto",
    "reduced",
    "rig_from_proto",
    "rig_to_proto",
    "timings_from_proto",
    "timings_to_proto",
]
