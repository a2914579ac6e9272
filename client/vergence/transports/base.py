"""What a session needs of a transport; everything else is written once, above it."""

from typing import Protocol, TypeVar

from google.protobuf.message import Message

from vergence_proto.errors import NotReady
from vergence_proto.v1 import depth_pb2 as pb

Answer = TypeVar("Answer", bound=Message)


class ConnectionLost(NotReady):
    """The server cannot be reached, or the way to it broke; a session tries to resume."""


class Call(Protocol):
    """One attachment to a stream: requests go up, responses come down, each in order."""

    async def send(self, request: bytes) -> None:
        """Hand over one ``pb.StreamDepthRequest``, serialized, waiting while the way is full.

        A message to a call that has ended is lost without a word here: ``receive`` says why.
        """

    async def receive(self) -> pb.StreamDepthResponse | None:
        """The next message; None once the server has ended the call in peace.

        Raises the DepthError with which the server ended the call, or ConnectionLost.
        """

    async def close(self) -> None:
        """Give the call up, wherever it stands."""


class Transport(Protocol):
    async def open_call(self, stream_id: str) -> Call:
        """Start a StreamDepth call; every frame of ``stream_id`` must reach the same server."""

    async def ask(self, method: str, request: Message, answer: type[Answer]) -> Answer:
        """One request, one answer: a unary method of DepthService by its name."""

    async def close(self) -> None:
        """Close the connection; calls that are still open end with ConnectionLost."""
