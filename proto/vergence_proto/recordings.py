"""The layout of a recording: one MCAP file (https://mcap.dev) with the messages of a session.

======================  ==============================  ==========================================
topic                   schema (protobuf)               content
======================  ==============================  ==========================================
``/vergence/stream``    ``vergence.v1.OpenStream``      rig, axes and options, without secrets; once
``/vergence/opened``    ``vergence.v1.StreamOpened``    model and rectified rig; once
``/vergence/frame``     ``vergence.v1.Frame``           id, time and pose, without image data
``/vergence/disparity`` ``vergence.v1.DisparityMap``    the answer, as it came from the server
``/left/image``         ``foxglove.CompressedImage``    the bytes that were sent; ``RawImage`` if
and ``/right/image``                                    they were not compressed
``/left/calibration``   ``foxglove.CameraCalibration``  one for each image topic
and ``/right/...``
``/depth/calibration``  ``foxglove.CameraCalibration``  of the rectified left camera
``/depth/image``        ``foxglove.RawImage``           16UC1, millimetres (REP 118); 0: no value
``/tf``                 ``foxglove.FrameTransform``     ``world`` from ``left``, in OpenCV axes
======================  ==============================  ==========================================

Viewers show the topics with schemas of Foxglove. A replay uses those of ``vergence``: it sends the
bytes that were sent. All messages of a frame have one log time, which increases from frame to
frame; their publish time is the time of capture. A frame without an answer is not in the file.
"""

from collections.abc import Iterator
from typing import Any

from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message

STREAM = "/vergence/stream"
OPENED = "/vergence/opened"
FRAME = "/vergence/frame"
DISPARITY = "/vergence/disparity"
LEFT_IMAGE = "/left/image"
RIGHT_IMAGE = "/right/image"
LEFT_CALIBRATION = "/left/calibration"
RIGHT_CALIBRATION = "/right/calibration"
DEPTH_CALIBRATION = "/depth/calibration"
DEPTH_IMAGE = "/depth/image"
TRANSFORMS = "/tf"


def schema_of(message: Message) -> bytes:
    """Return the message's file and all that it imports, serialized as MCAP wants a schema."""
    files = FileDescriptorSet()
    for each in dict.fromkeys(_with_imports(message.DESCRIPTOR.file)):
        each.CopyToProto(files.file.add())
    return files.SerializeToString()


def _with_imports(file: Any) -> Iterator[Any]:
    for imported in file.dependencies:
        yield from _with_imports(imported)
    yield file
