"""Read the requests of a client from bytes, within limits, before protobuf reads them.

Only images may be large. They stay views of the message, and are never copied.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeVar

from google.protobuf.message import DecodeError, Message

from vergence_proto.codec.wire import Piece, WireField, fields_of
from vergence_proto.errors import BadShape, FrameTooLarge
from vergence_proto.v1 import depth_pb2 as pb

Kind = TypeVar("Kind", bound=Message)

MAX_SMALL_BYTES = 64 << 10
"""The limit on a message without images; the largest that a client sends has a kilobyte."""
_MAX_BESIDE_IMAGES = 4 << 10  # these fields are walked in Python

_FRAME = pb.StreamDepthRequest.FRAME_FIELD_NUMBER
_IMAGES = (pb.Frame.LEFT_FIELD_NUMBER, pb.Frame.RIGHT_FIELD_NUMBER)
_SMALL_KINDS: dict[int, type[pb.OpenStream | pb.Ping | pb.Reset | pb.End]] = {
    pb.StreamDepthRequest.OPEN_FIELD_NUMBER: pb.OpenStream,
    pb.StreamDepthRequest.PING_FIELD_NUMBER: pb.Ping,
    pb.StreamDepthRequest.RESET_FIELD_NUMBER: pb.Reset,
    pb.StreamDepthRequest.END_FIELD_NUMBER: pb.End,
}


@dataclass(frozen=True, slots=True, eq=False)
class ReceivedImage:
    """An image as it arrived, not decoded."""

    header: pb.Image
    """The message without its data."""
    data: Piece
    """The data, a view of the bytes in which the message arrived."""


@dataclass(frozen=True, slots=True, eq=False)
class ReceivedFrame:
    """A frame as it arrived, not decoded."""

    fields: pb.Frame
    """The message without its images."""
    left: ReceivedImage
    """The left image."""
    right: ReceivedImage
    """The right image."""
    nbytes: int
    """The bytes that this frame keeps in memory."""

    @property
    def frame_id(self) -> int:
        """The id that the client gave the frame."""
        return self.fields.frame_id

    @classmethod
    def of(cls, message: pb.Frame) -> "ReceivedFrame":
        """Take a message apart. Its images are copied."""
        return read_frame(message.SerializeToString())


Request = pb.OpenStream | ReceivedFrame | pb.Ping | pb.Reset | pb.End
"""What one StreamDepthRequest contains."""


def read_request(data: Piece) -> Request:
    """Read the bytes of a ``pb.StreamDepthRequest``.

    Raises FrameTooLarge: too many bytes are no image data.
    Raises BadShape: the bytes are another message, or name more than one message or image of the
    same place.
    """
    view = memoryview(data)
    number, content, extra = 0, memoryview(b""), 0
    for field in _fields(view):
        if field.number == _FRAME or field.number in _SMALL_KINDS:
            if number or field.content is None:
                raise BadShape("expected one of the messages of depth.proto, got several")
            number, content = field.number, field.content
        else:  # of a newer version
            extra += len(field.whole)
            _check_size(extra, _MAX_BESIDE_IMAGES)
    if number == _FRAME:
        return read_frame(content)
    if number == 0:
        raise BadShape("expected one of the messages of depth.proto, got none")
    return read_small(_SMALL_KINDS[number], content)


def read_frame(data: Piece) -> ReceivedFrame:
    """Read the bytes of a ``pb.Frame``. Raises as :func:`read_request` does."""
    view = memoryview(data)
    parts, images = _split(view, _IMAGES)
    left, right = (_read_image(images.get(number, memoryview(b""))) for number in _IMAGES)
    return ReceivedFrame(_parsed(pb.Frame, parts), left, right, len(view))


def read_small(kind: type[Kind], data: Piece) -> Kind:
    """Read the bytes of a message without images.

    Raises FrameTooLarge: there are more than ``MAX_SMALL_BYTES``.
    Raises BadShape: the bytes are another message.
    """
    _check_size(len(data), MAX_SMALL_BYTES)
    return _parsed(kind, bytes(data))


def _read_image(view: memoryview) -> ReceivedImage:
    parts, data = _split(view, (pb.Image.DATA_FIELD_NUMBER,))
    content = data.get(pb.Image.DATA_FIELD_NUMBER, memoryview(b""))
    return ReceivedImage(_parsed(pb.Image, parts), content)


def _split(view: memoryview, large: tuple[int, ...]) -> tuple[bytes, dict[int, memoryview]]:
    """Return the bytes of all small fields, and the contents of the ``large`` ones."""
    small: list[memoryview] = []
    contents: dict[int, memoryview] = {}
    size = 0
    for field in _fields(view):
        if field.number not in large:
            size += len(field.whole)
            _check_size(size, _MAX_BESIDE_IMAGES)
            small.append(field.whole)
        elif field.number in contents or field.content is None:
            raise BadShape(f"expected field {field.number} once, with bytes")
        else:
            contents[field.number] = field.content
    return b"".join(small), contents


def _fields(view: memoryview) -> Iterator[WireField]:
    try:
        yield from fields_of(view)
    except ValueError as error:
        raise _other_bytes(str(error)) from None


def _parsed(kind: type[Kind], data: bytes) -> Kind:
    try:
        return kind.FromString(data)
    except DecodeError:
        raise _other_bytes(f"no {kind.DESCRIPTOR.name}") from None


def _check_size(size: int, limit: int) -> None:
    if size > limit:
        raise FrameTooLarge(f"expected at most {limit} bytes beside the images, got {size} or more")


def _other_bytes(why: str) -> BadShape:
    return BadShape(f"expected messages of vergence.v1, got other bytes: {why}")
