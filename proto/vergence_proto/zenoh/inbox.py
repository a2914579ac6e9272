"""A queue for the messages of one attachment, from Zenoh's threads to the event loop."""

import asyncio
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from functools import partial

import zenoh
from google.protobuf.message import DecodeError, Message
from google.rpc import status_pb2

from vergence_proto.codec import ReceivedFrame, read_frame, read_small
from vergence_proto.errors import DepthError, Quota
from vergence_proto.v1 import depth_pb2 as pb
from vergence_proto.zenoh.keys import encoding_of

# All messages except images and maps are small, and about one of them comes with each of those.
_SMALL_MESSAGES = 256

Received = Message | ReceivedFrame

# Messages to the server are read within limits; those to the client come from a server it chose.
_READERS: dict[str, Callable[[bytes], Received]] = {
    encoding_of(pb.Frame()): read_frame,
    **{encoding_of(kind()): partial(read_small, kind) for kind in (pb.Ping, pb.Reset, pb.End)},
    **{
        encoding_of(kind()): kind.FromString
        for kind in (pb.DisparityMap, pb.StreamDepthResponse, status_pb2.Status)
    },
}


class InboxFull(Quota):
    """The other side sent more than this side has asked for."""


class Inbox:
    """Messages in the order of their arrival, decoded when they are taken.

    At most ``max_bulky`` messages of type ``bulky`` wait. If one more arrives and ``drop_oldest``
    is set, the oldest bulky message is dropped; all other messages keep their place in the order.
    Without ``drop_oldest`` the inbox ends with InboxFull: the sender has exceeded its credit.
    """

    def __init__(
        self, attachment_id: str, *, bulky: type[Message], max_bulky: int, drop_oldest: bool
    ) -> None:
        self._attachment_id = attachment_id.encode()
        self._bulky = encoding_of(bulky())
        self._max_bulky = max_bulky
        self._drop_oldest = drop_oldest
        self._waiting: deque[tuple[str, zenoh.ZBytes | Message]] = deque()
        self._lock = threading.Lock()
        self._loop = asyncio.get_running_loop()
        self._arrived = asyncio.Event()
        self._end: Exception | None = None

    def put(self, sample: zenoh.Sample) -> None:
        """Add a message from Zenoh's thread, without a copy and without waiting.

        Messages of another attachment are discarded.
        """
        attachment, encoding = sample.attachment, str(sample.encoding)
        if attachment is None or attachment.to_bytes() != self._attachment_id:
            return
        bulky = encoding == self._bulky
        with self._lock:
            kinds = enumerate(kind == self._bulky for kind, _ in self._waiting)
            alike = [index for index, is_bulky in kinds if is_bulky == bulky]
            if len(alike) < (self._max_bulky if bulky else _SMALL_MESSAGES):
                self._waiting.append((encoding, sample.payload))
            elif bulky and self._drop_oldest:
                del self._waiting[alike[0]]
                self._waiting.append((encoding, sample.payload))
            else:
                self._end = self._end or InboxFull(
                    "more messages wait than the credit allows; send only when answers arrive"
                )
        with suppress(RuntimeError):  # the loop has closed before the session
            self._loop.call_soon_threadsafe(self._arrived.set)

    def put_local(self, message: Message) -> None:
        """Add a message that this side made itself, from the event loop."""
        with self._lock:
            self._waiting.append(("", message))
        self._arrived.set()

    def end(self, error: Exception) -> None:
        """Accept the end: :meth:`take` raises ``error`` once all waiting messages are taken."""
        self._end = self._end or error
        self._arrived.set()

    async def take(self) -> Received:
        """Remove and return the oldest message; wait until there is one.

        A message that does not decode is discarded, as if the network had lost it.
        Raises the error given to :meth:`end`, or InboxFull: too many messages wait.
        """
        while True:
            with self._lock:
                encoding, payload = self._waiting.popleft() if self._waiting else ("", None)
            if isinstance(payload, Message):
                return payload
            if payload is not None:
                with suppress(DecodeError, DepthError, KeyError):
                    return _READERS[encoding](payload.to_bytes())
            elif self._end is not None:
                raise self._end
            else:
                self._arrived.clear()
                await self._arrived.wait()
