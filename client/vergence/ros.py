"""Results as ROS messages, without ROS: plain dictionaries with the fields of each message.

The dictionaries have the names and types of the message definitions, so that
``rosidl_runtime_py.set_message_fields(message, values)``, ``rosbridge`` and ``rclpy`` constructors
take them. Images are bytes, row by row. All frames are optical frames (x right, y down, z forward;
REP 103). Depth images follow REP 118.
"""

import sys
from typing import Any, Literal

import numpy as np

from vergence.depth_formats import webxr
from vergence.results import DepthResult
from vergence_proto.geometry import RectifiedRig

Message = dict[str, Any]

_NS_PER_S = 1_000_000_000


def header(stamp_ns: int, frame_id: str) -> Message:
    """Return a ``std_msgs/Header``: a time in nanoseconds, and the name of an optical frame."""
    return {
        "stamp": {"sec": stamp_ns // _NS_PER_S, "nanosec": stamp_ns % _NS_PER_S},
        "frame_id": frame_id,
    }


def depth_image(
    result: DepthResult,
    *,
    frame_id: str,
    encoding: Literal["32FC1", "16UC1"] = "32FC1",
    stamp_ns: int | None = None,
) -> Message:
    """Return depth as a ``sensor_msgs/Image`` of REP 118.

    Parameters
    ----------
    result
        The result of a frame.
    frame_id
        The name of the rectified left camera's optical frame.
    encoding
        ``32FC1``: metres as float32, NaN where there is no value. ``16UC1``: millimetres, 0 where
        there is none or it is beyond 65.535 m.
    stamp_ns
        The time of capture on the clock of ROS; default: ``result.capture_ns``.
    """
    pixels: np.ndarray[Any, Any] = result.depth_m
    if encoding == "16UC1":
        pixels = webxr(result.depth_m, meters_per_unit=0.001)  # the same numbers
    return _image(pixels, encoding, _header(result, frame_id, stamp_ns))


def disparity_image(result: DepthResult, *, frame_id: str, stamp_ns: int | None = None) -> Message:
    """Return a ``stereo_msgs/DisparityImage``.

    Its disparity is ``u_left - u_right`` in the images, as ROS defines it, and a value below
    ``min_disparity`` means none. ``Z = f * T / (disparity - (cx_left - cx_right))``.
    """
    rig = result.rig
    head = _header(result, frame_id, stamp_ns)
    # ROS has no NaN here: a number below min_disparity is no value.
    lowest = min(0.0, rig.offset_of_zero_disparity_px)
    disparity = np.where(result.valid, result.offset_px, np.float32(lowest - 1)).astype(np.float32)
    largest = float(disparity.max(initial=lowest))
    return {
        "header": head,
        "image": _image(disparity, "32FC1", head),
        "f": rig.fx,
        "t": rig.baseline_m,
        "valid_window": _region(rig.width, rig.height),
        "min_disparity": lowest,
        "max_disparity": largest,
        "delta_d": 1 / 64,
    }


def camera_info(
    rig: RectifiedRig,
    *,
    frame_id: str,
    stamp_ns: int,
    side: Literal["left", "right"] = "left",
) -> Message:
    """Return a ``sensor_msgs/CameraInfo`` of one camera of a rectified rig.

    The right camera's projection has ``-fx * baseline_m`` in ``P[3]``, as ROS defines it for the
    second camera of a pair. The frame id of both is the left camera's optical frame.
    """
    cx = rig.cx_left if side == "left" else rig.cx_right
    shift = 0.0 if side == "left" else -rig.fx * rig.baseline_m
    return {
        "header": header(stamp_ns, frame_id),
        "height": rig.height,
        "width": rig.width,
        "distortion_model": "plumb_bob",
        "d": [0.0] * 5,
        "k": [rig.fx, 0.0, cx, 0.0, rig.fy, rig.cy, 0.0, 0.0, 1.0],
        "r": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        "p": [rig.fx, 0.0, cx, shift, 0.0, rig.fy, rig.cy, 0.0, 0.0, 0.0, 1.0, 0.0],
        "binning_x": 0,
        "binning_y": 0,
        "roi": _region(0, 0),
    }


def _header(result: DepthResult, frame_id: str, stamp_ns: int | None) -> Message:
    return header(result.capture_ns if stamp_ns is None else stamp_ns, frame_id)


def _image(pixels: np.ndarray[Any, Any], encoding: str, head: Message) -> Message:
    height, width = pixels.shape
    return {
        "header": head,
        "height": height,
        "width": width,
        "encoding": encoding,
        "is_bigendian": int(sys.byteorder == "big"),
        "step": width * pixels.itemsize,
        "data": np.ascontiguousarray(pixels).tobytes(),
    }


def _region(width: int, height: int) -> Message:
    """A ``sensor_msgs/RegionOfInterest`` from the upper left corner; 0x0: the whole image."""
    return {"x_offset": 0, "y_offset": 0, "height": height, "width": width, "do_rectify": False}
