"""gRPC: one HTTP/2 connection per client."""

import asyncio
import contextlib
from typing import cast

import grpc
from google.protobuf.message import Message
from grpc_status import rpc_status

from vergence.transports.base import Answer, Call, ConnectionLost
from vergence_proto import codec
from vergence_proto.errors import DepthError, FrameTooLarge, NotReady
from vergence_proto.keys import STREAM_ID_METADATA
from vergence_proto.v1 import depth_pb2 as pb

_SERVICE = "/vergence.v1.DepthService/"
_ASK_TIMEOUT_S = 10.0

_CHANNEL_OPTIONS = (
    # Images exceed gRPC's default of 4 MiB; what is too large is for the server to say.
    ("grpc.max_send_message_length", -1),
    ("grpc.max_receive_message_length", -1),
    # Without these a server that vanished silently is noticed after two hours.
    ("grpc.keepalive_time_ms", 10_000),
    ("grpc.keepalive_timeout_ms", 5_000),
    # gRPC itself waits 1 s to 2 min between attempts and fails every call made meanwhile; the
    # session has a backoff of its own, and only the server's grace to come back in.
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.min_reconnect_backoff_ms", 100),
    ("grpc.max_reconnect_backoff_ms", 500),
    # Otherwise two clients in one process share one connection and its backoff.
    ("grpc.use_local_subchannel_pool", 1),
)


class GrpcTransport:
    """The :class:`~vergence.transports.base.Transport` to one ``host:port``, in the clear."""

    def __init__(self, address: str) -> None:
        self._address = address
        self._channel = grpc.aio.insecure_channel(address, options=_CHANNEL_OPTIONS)

    async def open_call(self, stream_id: str) -> Call:
        start = self._channel.stream_stream(
            f"{_SERVICE}StreamDepth",
            request_serializer=pb.StreamDepthRequest.SerializeToString,
            response_deserializer=pb.StreamDepthResponse.FromString,
        )
        call = start(request_iterator=None, metadata=((STREAM_ID_METADATA, stream_id),))
        return _GrpcCall(call, self._address)

    async def ask(self, method: str, request: Message, answer: type[Answer]) -> Answer:
        invoke = self._channel.unary_unary(
            f"{_SERVICE}{method}",
            request_serializer=type(request).SerializeToString,
            response_deserializer=answer.FromString,
        )
        try:
            response: Answer = await invoke(request, timeout=_ASK_TIMEOUT_S)
        except grpc.aio.AioRpcError as error:
            raise _error_from_rpc(error, self._address) from None
        return response

    async def close(self) -> None:
        await self._channel.close(grace=None)


class _GrpcCall:
    def __init__(
        self,
        call: "grpc.aio.StreamStreamCall[pb.StreamDepthRequest, pb.StreamDepthResponse]",
        address: str,
    ) -> None:
        self._call = call
        self._address = address

    async def send(self, request: pb.StreamDepthRequest) -> None:
        # Both mean that the call has ended: before this write, or during it.
        with contextlib.suppress(asyncio.InvalidStateError, grpc.aio.AioRpcError):
            await self._call.write(request)

    async def receive(self) -> pb.StreamDepthResponse | None:
        try:
            response = await self._call.read()
        except grpc.aio.AioRpcError as error:
            raise _error_from_rpc(error, self._address) from None
        except asyncio.CancelledError:
            # gRPC raises it also where nobody cancelled this task but the channel was closed.
            task = asyncio.current_task()
            if task is not None and task.cancelling():
                raise
            raise ConnectionLost(f"the connection to {self._address} was closed") from None
        return response if isinstance(response, pb.StreamDepthResponse) else None

    async def close(self) -> None:
        self._call.cancel()


def _error_from_rpc(error: grpc.aio.AioRpcError, address: str) -> DepthError:
    """The class the server raised, by its ErrorInfo; without one the trouble is on the way."""
    status = rpc_status.from_call(cast(grpc.Call, error))  # it has all that is read of one
    ours = codec.error_from_status(status) if status is not None else None
    if ours is not None:
        return ours
    code, details = error.code(), error.details()
    if code is grpc.StatusCode.RESOURCE_EXHAUSTED:  # gRPC's own limit on a message
        return FrameTooLarge(f"{address} refused the message: {details}")
    if code is grpc.StatusCode.UNIMPLEMENTED:
        return NotReady(f"{address} speaks gRPC but does not offer vergence.v1: {details}")
    # The end of gRPC's sentence is the part that tells something.
    reason = (details or code.name).rpartition("last error: ")[2].removeprefix("UNKNOWN: ")
    return ConnectionLost(f"no connection to {address}: {reason}")
