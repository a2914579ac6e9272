"""All errors that a caller can receive, as one closed family.

::

    DepthError
    |-- BadImage, BadPose, BadShape, BadCalibration      the request is wrong
    |-- UnknownStream, StreamExpired                     the stream does not exist, or no longer
    |-- StreamExists, Superseded                         another client has the stream
    |-- FrameOutOfOrder, ModelChanged                    the stream's state does not allow it
    |-- StreamLimit, StateMemory, Quota, FrameTooLarge   a limit of the server is exceeded
    |-- FrameStale                                       too late to be useful
    |-- ClientTimeout                                    the client sends too slowly
    |-- BadSequence, UploadTooLarge                      an uploaded sequence is refused
    |-- UnknownSequence, SequenceNotDone, QueueFull      the job or its result is not available
    |-- InsufficientStorage                              the server's disk has no room
    |-- Unauthenticated, Forbidden                       no valid credential, or too few rights
    |-- KeyReused, KeyInUse                              an Idempotency-Key of another request
    |-- Draining, NotReady                               not now: try again, or on another server
    `-- ModelFailed, NonFinite                           the server's own failure

There is one class per :class:`ErrorCode`. The wire carries the code and the message, and the SDK
raises the same class as the server. A message states what was expected, what came, and what to do.
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
    CLIENT_TIMEOUT = "CLIENT_TIMEOUT"
    DRAINING = "DRAINING"
    NOT_READY = "NOT_READY"
    MODEL_FAILED = "MODEL_FAILED"
    NON_FINITE = "NON_FINITE"
    BAD_SEQUENCE = "BAD_SEQUENCE"
    UPLOAD_TOO_LARGE = "UPLOAD_TOO_LARGE"
    SEQUENCE_UNKNOWN = "SEQUENCE_UNKNOWN"
    SEQUENCE_NOT_DONE = "SEQUENCE_NOT_DONE"
    QUEUE_FULL = "QUEUE_FULL"
    INSUFFICIENT_STORAGE = "INSUFFICIENT_STORAGE"
    UNAUTHENTICATED = "UNAUTHENTICATED"
    FORBIDDEN = "FORBIDDEN"
    KEY_REUSED = "KEY_REUSED"
    KEY_IN_USE = "KEY_IN_USE"


ERROR_DOMAIN = "vergence"  # google.rpc.ErrorInfo.domain


class DepthError(Exception):
    """Base class of all errors that a caller can receive."""

    code: ClassVar[ErrorCode]
    """The error's code on the wire."""
    retry_after_s: float | None
    """Seconds after which a new attempt may succeed; None if waiting does not help."""

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
    """No stream with this id is open, and none was open in the last minutes."""

    code = ErrorCode.STREAM_UNKNOWN


class StreamExpired(DepthError):
    """The stream was idle or detached for too long, and the server has deleted its state."""

    code = ErrorCode.STREAM_EXPIRED


class StreamExists(DepthError):
    """A stream with this id is open, and the request has no resume token for it."""

    code = ErrorCode.STREAM_EXISTS


class Superseded(DepthError):
    """A newer connection attached to this stream; the newest attachment wins."""

    code = ErrorCode.SUPERSEDED


class FrameOutOfOrder(DepthError):
    """The frame's id is not above the id of the last frame that this stream accepted."""

    code = ErrorCode.FRAME_OUT_OF_ORDER


class ModelChanged(DepthError):
    """The server runs other weights than the stream's; to use them, open a new stream."""

    code = ErrorCode.MODEL_CHANGED


class StreamLimit(DepthError):
    """The server has as many open streams as its configuration allows."""

    code = ErrorCode.STREAM_LIMIT


class StateMemory(DepthError):
    """The server's memory does not suffice: its configured limit, or the process's own."""

    code = ErrorCode.STATE_MEMORY


class Quota(DepthError):
    """The caller sends more than its credit or quota allows."""

    code = ErrorCode.QUOTA


class FrameTooLarge(DepthError):
    """The frame's bytes or pixels exceed the configured limit."""

    code = ErrorCode.FRAME_TOO_LARGE


class FrameStale(DepthError):
    """The frame waited longer than its maximum age; the stream's state is unchanged."""

    code = ErrorCode.FRAME_STALE


class ClientTimeout(DepthError):
    """The client did not send its first message, its headers or its body in time."""

    code = ErrorCode.CLIENT_TIMEOUT


class Draining(DepthError):
    """The server is shutting down and accepts no new streams; try another server."""

    code = ErrorCode.DRAINING


class NotReady(DepthError):
    """The server is starting, or it cannot be reached."""

    code = ErrorCode.NOT_READY


class ModelFailed(DepthError):
    """The model failed; the stream's state is as it was before the frame."""

    code = ErrorCode.MODEL_FAILED


class NonFinite(DepthError):
    """The model's result was not finite; the frame has no result and the stream starts cold."""

    code = ErrorCode.NON_FINITE


class BadSequence(DepthError):
    """An upload does not unpack, or it holds no sequence of a supported data set."""

    code = ErrorCode.BAD_SEQUENCE


class UploadTooLarge(DepthError):
    """An upload is larger than allowed, packed or unpacked."""

    code = ErrorCode.UPLOAD_TOO_LARGE


class UnknownSequence(DepthError):
    """There is no job with this id: none was created, or it was deleted or has expired."""

    code = ErrorCode.SEQUENCE_UNKNOWN


class SequenceNotDone(DepthError):
    """The job has no results: it is waiting or running, or it has failed."""

    code = ErrorCode.SEQUENCE_NOT_DONE


class QueueFull(DepthError):
    """The queue of sequences is full, or the disk has no room for another sequence."""

    code = ErrorCode.QUEUE_FULL


class InsufficientStorage(DepthError):
    """The disk of the server is full, read-only or failing, or too small for the upload."""

    code = ErrorCode.INSUFFICIENT_STORAGE


class Unauthenticated(DepthError):
    """The server asks for a token or a certificate, and the request has no valid one."""

    code = ErrorCode.UNAUTHENTICATED


class Forbidden(DepthError):
    """The caller has no right to this, or a foreign web page sent the request."""

    code = ErrorCode.FORBIDDEN


class KeyReused(DepthError):
    """The Idempotency-Key belongs to a request with another body or other options."""

    code = ErrorCode.KEY_REUSED


class KeyInUse(DepthError):
    """The first request with this Idempotency-Key is still being received."""

    code = ErrorCode.KEY_IN_USE


ERROR_CLASSES: dict[ErrorCode, type[DepthError]] = {
    error.code: error for error in DepthError.__subclasses__()
}


def error_from_wire(reason: str, message: str, retry_after_s: float | None = None) -> DepthError:
    """Return the error that the server raised; an unknown reason becomes ModelFailed.

    A newer server may have reasons that this version does not know.
    """
    known = reason in ErrorCode.__members__
    error_class = ERROR_CLASSES[ErrorCode(reason)] if known else ModelFailed
    return error_class(message if known else f"{reason}: {message}", retry_after_s=retry_after_s)
