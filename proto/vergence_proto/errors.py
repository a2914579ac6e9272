"""Everything a caller can be told about, as one closed family.

::

    DepthError
    |-- BadImage, BadPose, BadShape, BadCalibration      the request is wrong
    |-- UnknownStream, StreamExpired                     there is no such stream (any more)
    |-- StreamExists, Superseded                         somebody else has it
    |-- FrameOutOfOrder, ModelChanged                    not in this state of the stream
    |-- StreamLimit, StateMemory, Quota, FrameTooLarge   more than the server gives
    |-- FrameStale                                       too late to be useful
    |-- BadSequence, UploadTooLarge                      a whole sequence cannot be taken
    |-- UnknownSequence, SequenceNotDone, QueueFull      its job is not there, or not yet
    |-- Draining, NotReady                               not now: try again, or elsewhere
    `-- ModelFailed, NonFinite                           the server's own failure

There is one class per :class:`ErrorCode`. The code crosses the wire with the message and the SDK
raises the class that the server raised. A message says what was expected, what came, what to do.
"""

from enum import StrEnum
from typing import ClassVar


class ErrorCode(StrEnum):
    """The reason on the wire (``google.rpc.ErrorInfo.reason``, problem+json ``reason``)."""

    BAD_IMAGE = "BAD_IMAGE"
    BAD_POSE = "BAD_POSE"
    BAD_SHAPE = "BAD_SHAPE"
    BAD_CALIBRATION = "BAD_CALIBRATION"
    STREAM_UNKNOWN = "STREAM_UNKNOWN"
    STREAM_EXPIRED = "STREAM_EXPIRED"
    STREAM_EXISTS = "STREAM_EXISTS"
    SUPERSEDED = "SUPERSEDED"
    FRAME_OUT_OF_ORDER = "FRAME_OUT_OF_ORDER"
    MODEL_CHANGED = "MODEL_CHANGED"
    STREAM_LIMIT = "STREAM_LIMIT"
    STATE_MEMORY = "STATE_MEMORY"
    QUOTA = "QUOTA"
    FRAME_TOO_LARGE = "FRAME_TOO_LARGE"
    FRAME_STALE = "FRAME_STALE"
    DRAINING = "DRAINING"
    NOT_READY = "NOT_READY"
    MODEL_FAILED = "MODEL_FAILED"
    NON_FINITE = "NON_FINITE"
    BAD_SEQUENCE = "BAD_SEQUENCE"
    UPLOAD_TOO_LARGE = "UPLOAD_TOO_LARGE"
    SEQUENCE_UNKNOWN = "SEQUENCE_UNKNOWN"
    SEQUENCE_NOT_DONE = "SEQUENCE_NOT_DONE"
    QUEUE_FULL = "QUEUE_FULL"


ERROR_DOMAIN = "vergence"  # google.rpc.ErrorInfo.domain


class DepthError(Exception):
    """Base of all a caller can be told about; ``retry_after_s`` is set where waiting helps."""

    code: ClassVar[ErrorCode]

    def __init__(self, message: str, *, retry_after_s: float | None = None) -> None:
        super().__init__(message)
        self.retry_after_s = retry_after_s


class BadImage(DepthError):
    """The image bytes do not decode to what the message says they are."""

    code = ErrorCode.BAD_IMAGE


class BadPose(DepthError):
    """The pose is not finite, or its quaternion is not of unit length."""

    code = ErrorCode.BAD_POSE


class BadShape(DepthError):
    """An image's size is not the one the stream was opened with, or a field is out of range."""

    code = ErrorCode.BAD_SHAPE


class BadCalibration(DepthError):
    """The rig cannot be used for stereo: zero baseline, non-positive focal length, and the like."""

    code = ErrorCode.BAD_CALIBRATION


class UnknownStream(DepthError):
    """No stream of this id is open, and none was in the last minutes."""

    code = ErrorCode.STREAM_UNKNOWN


class StreamExpired(DepthError):
    """The stream was open, was left idle or detached too long, and its state is gone."""

    code = ErrorCode.STREAM_EXPIRED


class StreamExists(DepthError):
    """A stream of this id is open and the request carried no resume token for it."""

    code = ErrorCode.STREAM_EXISTS


class Superseded(DepthError):
    """A newer connection attached to this stream; the newest attachment wins."""

    code = ErrorCode.SUPERSEDED


class FrameOutOfOrder(DepthError):
    """The frame's id is not above that of the last frame accepted on this stream."""

    code = ErrorCode.FRAME_OUT_OF_ORDER


class ModelChanged(DepthError):
    """The server runs other weights than the stream's; open a new stream to go on with them."""

    code = ErrorCode.MODEL_CHANGED


class StreamLimit(DepthError):
    """The server holds as many streams as it is configured to."""

    code = ErrorCode.STREAM_LIMIT


class StateMemory(DepthError):
    """The states of all streams together would exceed the configured memory."""

    code = ErrorCode.STATE_MEMORY


class Quota(DepthError):
    """The caller sends more than its share."""

    code = ErrorCode.QUOTA


class FrameTooLarge(DepthError):
    """The frame's bytes or pixels exceed the configured limit."""

    code = ErrorCode.FRAME_TOO_LARGE


class FrameStale(DepthError):
    """The frame waited longer than its maximum age; the state was not touched."""

    code = ErrorCode.FRAME_STALE


class Draining(DepthError):
    """The server is shutting down and takes no new streams; try another one."""

    code = ErrorCode.DRAINING


class NotReady(DepthError):
    """The server is starting, or cannot be reached."""

    code = ErrorCode.NOT_READY


class ModelFailed(DepthError):
    """The model raised; the stream is as it was before the frame."""

    code = ErrorCode.MODEL_FAILED


class NonFinite(DepthError):
    """The model's result was not finite; the frame was dropped and the stream starts anew."""

    code = ErrorCode.NON_FINITE


class BadSequence(DepthError):
    """An upload does not unpack, or what it holds is no sequence in a layout that is read."""

    code = ErrorCode.BAD_SEQUENCE


class UploadTooLarge(DepthError):
    """An upload is larger than allowed, as it travels or once it is unpacked."""

    code = ErrorCode.UPLOAD_TOO_LARGE


class UnknownSequence(DepthError):
    """There is no job of this id: it never was, was deleted, or its results have expired."""

    code = ErrorCode.SEQUENCE_UNKNOWN


class SequenceNotDone(DepthError):
    """The job has no results: it waits, runs, or failed."""

    code = ErrorCode.SEQUENCE_NOT_DONE


class QueueFull(DepthError):
    """As many sequences wait as may, or there is no room on disk for another one."""

    code = ErrorCode.QUEUE_FULL


ERROR_CLASSES: dict[ErrorCode, type[DepthError]] = {
    error.code: error for error in DepthError.__subclasses__()
}


def error_from_wire(reason: str, message: str, retry_after_s: float | None = None) -> DepthError:
    """The error the other side raised; an unknown reason (a newer server) becomes ModelFailed."""
    known = reason in ErrorCode.__members__
    error_class = ERROR_CLASSES[ErrorCode(reason)] if known else ModelFailed
    return error_class(message if known else f"{reason}: {message}", retry_after_s=retry_after_s)
