"""Tables between the enums of the wire and those of :mod:`vergence_proto.types`, each total."""

from collections.abc import Mapping
from typing import TypeVar

from vergence_proto.errors import BadShape, DepthError
from vergence_proto.geometry import Axes
from vergence_proto.types import Delivery, Distortion, Origin, PlaneEncoding
from vergence_proto.v1 import depth_pb2 as pb

Number = TypeVar("Number", bound=int)
Value = TypeVar("Value")

# "Unspecified" is the number of a field that was not set; it means the default in depth.proto.
AXES = {
    pb.AXES_UNSPECIFIED: Axes.OPENCV,
    pb.AXES_OPENCV: Axes.OPENCV,
    pb.AXES_OPENXR: Axes.OPENXR,
    pb.AXES_UNITY: Axes.UNITY,
    pb.AXES_NED: Axes.NED,
    pb.AXES_ROS: Axes.ROS,
}
DISTORTION = {
    pb.DISTORTION_UNSPECIFIED: Distortion.NONE,
    pb.DISTORTION_NONE: Distortion.NONE,
    pb.DISTORTION_BROWN_CONRADY: Distortion.BROWN_CONRADY,
    pb.DISTORTION_KANNALA_BRANDT: Distortion.KANNALA_BRANDT,
}
DELIVERY = {
    pb.DELIVERY_UNSPECIFIED: Delivery.NEWEST,
    pb.DELIVERY_NEWEST: Delivery.NEWEST,
    pb.DELIVERY_EVERY: Delivery.EVERY,
}
DISPARITY_ENCODING = {
    pb.PLANE_ENCODING_UNSPECIFIED: PlaneEncoding.UINT16,
    pb.PLANE_ENCODING_UINT16: PlaneEncoding.UINT16,
    pb.PLANE_ENCODING_FLOAT16: PlaneEncoding.FLOAT16,
    pb.PLANE_ENCODING_FLOAT32: PlaneEncoding.FLOAT32,
}
# (compressed, deflate) of an OutputFormat
COMPRESSION = {
    pb.COMPRESSION_UNSPECIFIED: (True, False),
    pb.COMPRESSION_NONE: (False, False),
    pb.COMPRESSION_DELTA_ZSTD: (True, False),
    pb.COMPRESSION_DELTA_DEFLATE: (True, True),
}
ORIGIN = {
    pb.ORIGIN_UNSPECIFIED: Origin.WARM,
    pb.ORIGIN_WARM: Origin.WARM,
    pb.ORIGIN_COLD_START: Origin.COLD_START,
    pb.ORIGIN_RESUMED: Origin.RESUMED,
    pb.ORIGIN_RESET_REQUESTED: Origin.RESET_REQUESTED,
    pb.ORIGIN_RESET_POSE_LOST: Origin.RESET_POSE_LOST,
    pb.ORIGIN_RESET_POSE_JUMP: Origin.RESET_POSE_JUMP,
    pb.ORIGIN_RESET_GAP: Origin.RESET_GAP,
    pb.ORIGIN_RESET_TIME_BACKWARDS: Origin.RESET_TIME_BACKWARDS,
    pb.ORIGIN_RESET_NON_FINITE: Origin.RESET_NON_FINITE,
}


def value_of(
    table: Mapping[Number, Value],
    number: Number,
    field: str,
    error: type[DepthError] = BadShape,
) -> Value:
    """Return the value of a number.

    Raises ``error``: the number is unknown. Protobuf accepts unknown numbers, since a newer peer
    may send them.
    """
    if number not in table:
        raise error(f"{field}: expected one of {sorted(table)} as in depth.proto, got {number}")
    return table[number]


def number_of(table: Mapping[Number, Value], value: Value) -> Number:
    """Return the number of a value, never the number of "unspecified"."""
    return next(number for number, known in table.items() if number and known == value)
