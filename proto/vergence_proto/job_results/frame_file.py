r"""One frame of a job's result, as a server keeps it on disk and sends it.

::

    one line of JSON        the frame's record, as in frames.jsonl, and "parts"
    the parts, in order     "map": a DisparityMap of depth.proto
                            "left": the rectified left image, an image file

``parts`` lists name, size in bytes and CRC-32 of each part. A frame without a map has only its
record. Planes have 1/64 px: disparity equals the map of a live stream, rounded to that.
"""

import json
import zlib
from dataclasses import dataclass
from typing import Any

from google.protobuf.message import DecodeError

from vergence_proto import codec
from vergence_proto.errors import BadImage
from vergence_proto.geometry import RectifiedRig
from vergence_proto.job_results.records import FrameRecord
from vergence_proto.types import DisparityMap, OutputFormat
from vergence_proto.v1 import depth_pb2 as pb

STEPS_PER_PX = 64
SUFFIX = ".frame"
MEDIA_TYPE = "application/vnd.vergence.frame"


@dataclass(frozen=True, slots=True, eq=False)
class JobFrame:
    """One frame of a result."""

    record: FrameRecord
    disparity: DisparityMap | None
    """The maps, rounded to 1/64 px; None: there are none, and ``record.error`` says why."""
    left: bytes | None = None
    """The rectified left image as an image file, if the job was asked for it."""


def encode_frame(
    record: FrameRecord,
    disparity: DisparityMap | None,
    *,
    confidence: bool = False,
    sigma: bool = False,
    left: bytes | None = None,
) -> bytes:
    """Encode a frame, with the planes that are asked for."""
    parts: list[tuple[str, bytes]] = []
    if disparity is not None:
        output = OutputFormat(denominator=STEPS_PER_PX, confidence=confidence, sigma=sigma)
        message = codec.disparity_to_proto(disparity, output)
        message.ClearField("timings")  # the same input gives the same bytes
        parts.append(("map", message.SerializeToString(deterministic=True)))
    if left is not None:
        parts.append(("left", left))
    about = json.loads(record.to_json())
    about["parts"] = [[name, len(content), zlib.crc32(content)] for name, content in parts]
    return b"".join([json.dumps(about).encode(), b"\n", *(content for _, content in parts)])


def decode_record(data: bytes) -> FrameRecord:
    """Read the record in a frame file, or in its beginning. Raises BadImage: there is none."""
    return FrameRecord.from_values(_about(data)[0])


def decode_frame(data: bytes, rig: RectifiedRig | None) -> JobFrame:
    """Read a frame of a result with that rig; None: no frame of the job has a map.

    Raises BadImage: the file is damaged or cut short; and BadShape or BadPose: its map is no map of
    this rig.
    """
    about, start = _about(data)
    parts: dict[str, bytes] = {}
    for name, size, checksum in about["parts"]:
        content = data[start : start + size]
        if len(content) != size or zlib.crc32(content) != checksum:
            raise BadImage(f"the frame is damaged or cut short: its part {name!r} is not whole")
        parts[name] = content
        start += size
    record = FrameRecord.from_values(about)
    if "map" not in parts or rig is None:
        return JobFrame(record, None, parts.get("left"))
    try:
        message = pb.DisparityMap.FromString(parts["map"])
    except DecodeError:
        raise BadImage("the map of the frame is no DisparityMap") from None
    return JobFrame(record, codec.disparity_from_proto(message, rig), parts.get("left"))


def is_whole(data: bytes) -> bool:
    """Return whether every byte of a frame file is there and right."""
    try:
        about, start = _about(data)
    except BadImage:
        return False
    for _, size, checksum in about["parts"]:
        if zlib.crc32(data[start : start + size]) != checksum:
            return False
        start += size
    return start == len(data)


def _about(data: bytes) -> tuple[dict[str, Any], int]:
    line, end, _ = data.partition(b"\n")
    try:
        if end:
            about = json.loads(line)
            list(about["parts"])
            return about, len(line) + 1
    except (KeyError, TypeError, ValueError):
        pass
    raise BadImage(f"expected a frame of a job, got {data[:40]!r}")
