"""Where messages of one attachment wait, between Zenoh's threads and the event loop."""

import asyncio
import threading
from collections import deque
from contextlib import suppress

import zenoh
from google.protobuf.message import DecodeError, Message
from google.rpc import status_pb2

from vergence_proto.errors import Quota
from vergence_proto.v1 import depth_pb2 as pb
from vergence_proto.zenoh.keys import encoding_of

# Everything but images and maps is small, and comes about once for each of those.
_SMALL_MESSAGES = 256

_TYPES: dict[str, type[Message]] = {
    encoding_of(kind()): kind
    for kind in (
        pb.Frame,
        pb.Ping,
        pb.Reset,
        pb.End,
        pb.DisparityMap,
        pb.StreamDepthResponse,
        status_pb2.Status,
    )
}


class Inbox:
    """Messages in the order they came, decoded when they are taken.

    Of those of type ``bulky`` at most ``room`` wait. One more displaces the oldest of them if
    ``displaces``: with a room of one, that is Zenoh's ring channel of one, but for the other
    messages, which keep their place between the bulky ones. Otherwise it is the end: the sender
    has broken the rule of credit.
    """

    def __init__(
        self, attachment_id: str, *, bulky: type[Message], room: int, displaces: bool
    ) -> None:
        self._attachment_id = attachment_id.encode()
        self._bulky = encoding_of(bulky())
        self._room = room
        self._displaces = displaces
        self._waiting: deque[tuple[str, zenoh.ZBytes | Message]] = deque()
        self._lock = threading.Lock()
        self._loop = asyncio.get_running_loop()
        self._arrived = asyncio.Event()
        self._end: Exception | None = None

    def put(self, sample: zenoh.Sample) -> None:
        """Called in Zenoh's thread: copies nothing, and waits for nobody."""
        attachment, encoding = sample.attachment, str(sample.encoding)
        if attachment is None or attachment.to_bytes() != self._attachment_id:
            return
        bulky = encoding == self._bulky
        with self._lock:
            kinds = enumerate(kind == self._bulky for kind, _ in self._waiting)
            alike = [index for index, is_bulky in kinds if is_bulky == bulky]
            if len(alike) < (self._room if bulky else _SMALL_MESSAGES):
                self._waiting.append((encoding, sample.payload))
            elif bulky and self._displaces:
                del self._waiting[alike[0]]
                self._waiting.append((encoding, sample.payload))
            else:
                self._end = self._end or Quota("more messages wait than the credit allows")
        with suppress(RuntimeError):  # the loop has closed before the session
            self._loop.call_soon_threadsafe(self._arrived.set)

    def put_own(self, message: Message) -> None:
        """Called in the event loop: a message that this end has for itself."""
        with self._lock:
            self._waiting.append(("", message))
        self._arrived.set()

    def end(self, error: Exception) -> None:
        """Nothing comes any more: raise this once what waits is taken."""
        self._end = self._end or error
        self._arrived.set()

    async def take(self) -> Message:
        """The oldest message, waiting for one. Raises what it ended with.

        What does not decode is passed over, as if it had been lost on the way.
        """
        while True:
            with self._lock:
                encoding, payload = self._waiting.popleft() if self._waiting else ("", None)
            if isinstance(payload, Message):
                return payload
            if payload is not None:
                with suppress(DecodeError, KeyError):
                    return _TYPES[encoding].FromString(payload.to_bytes())
            elif self._end is not None:
                raise self._end
            else:
                self._arrived.clear()
                await self._arrived.wait()
