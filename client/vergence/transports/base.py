"""The protocol of a transport; everything above it is written once for all of them."""

from typing import Protocol, TypeVar

from google.protobuf.message import Message

from vergence_proto.errors import NotReady
from vergence_proto.v1 import depth_pb2 as pb

Answer = TypeVar("Answer", bound=Message)


class ConnectionLost(NotReady):
    """The server cannot be reached, or the connection to it broke.

    A session reconnects by itself. Raised from a session it is final for the frame, or, if the
    message says so, for the session.
    """


class ClientClosed(ConnectionLost):
    """The client was closed: no attempt will succeed."""

    def __init__(self) -> None:
        super().__init__("the client was closed")


class Call(Protocol):
    """One attachment to a stream: requests go up, responses come down, each in order."""

    async def send(self, request: bytes) -> None:
        """Send one serialized ``pb.StreamDepthRequest``; waits while buffers are full.

        A message to a call that has ended is discarded silently; ``receive`` raises the reason.
        """

    async def receive(self) -> pb.StreamDepthResponse | None:
        """Return the next message; None once the server has ended the call without an error.

        Raises the DepthError with which the server ended the call, or ConnectionLost.
        """

    async def close(self) -> None:
        """Abort the call."""


class Transport(Protocol):
    """One connection to a server, or to the servers of one Zenoh namespace."""

    async def open_call(self, stream_id: str) -> Call:
        """Connect, and start a StreamDepth call on a connection of its own.

        Every frame of ``stream_id`` must reach the same server. It may wait for as long as the
        network is silent. Raises ConnectionLost, and ClientClosed after :meth:`close`.
        """

    async def ask(self, method: str, request: Message, answer: type[Answer]) -> Answer:
        """Call a unary method of DepthService by its name."""

    async def close(self) -> None:
        """Close the connection; calls that are still open end with ConnectionLost."""
