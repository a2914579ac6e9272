"""The services over grpc.aio: depth and pairs, with the standard health and reflection."""

import asyncio
import logging
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable
from functools import partial
from typing import Any, Self
from urllib.parse import unquote

import grpc
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import Message
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection, reflection_pb2

from vergence_proto.codec import Request, read_request, read_small
from vergence_proto.open_inference import inference_pb2
from vergence_proto.v1 import depth_pb2 as pb
from vergence_service.access.gate import Gate
from vergence_service.access.principals import Principal
from vergence_service.transports.addresses import format_address, listening_socket
from vergence_service.transports.callers import CALLER
from vergence_service.transports.errors import PortTaken
from vergence_service.transports.grpc.deadlines import FirstMessageDeadline
from vergence_service.transports.grpc.errors import Context, errors_as_status
from vergence_service.transports.grpc.hang_up import hang_up
from vergence_service.transports.grpc.identity import Identity
from vergence_service.transports.grpc.inference_protocol import SERVICE as INFERENCE_SERVICE
from vergence_service.transports.grpc.inference_protocol import InferenceServicer
from vergence_service.transports.grpc.small_requests import SmallRequests
from vergence_service.transports.open_calls import FINISHING_SHARE, OpenCalls
from vergence_service.transports.stream_call import ClientLost
from vergence_service.transports.tls import Certificate
from vergence_service.transports.unary import UnaryMethods

log = logging.getLogger(__name__)

_SERVICE = pb.DESCRIPTOR.services_by_name["DepthService"].full_name

# A frame just above the limit is still received, so that the error can name the limit.
_ROOM_OVER_THE_LIMIT = 1.25

# Calls are limited too: a connection has at most so many, and the server so many more than
# connections.
_CALLS_OF_A_CONNECTION = 64
_MORE_CALLS = 64

# Images and maps are compressed already. With gRPC's own compression 30 kB could become a message
# of the largest size, before anything here has seen it.
_ONLY_IDENTITY = 1

# A client that vanished is noticed within 15 s instead of gRPC's two hours. Clients may ping every
# 5 s. A connection without calls is closed after 10 to 20 s.
_KEEPALIVE = (
    ("grpc.keepalive_time_ms", 10_000),
    ("grpc.keepalive_timeout_ms", 5_000),
    ("grpc.http2.ping_timeout_ms", 5_000),  # a minute by default, whatever keepalive_timeout_ms is
    ("grpc.max_connection_idle_ms", 10_000),
    ("grpc.keepalive_permit_without_calls", 1),
    ("grpc.http2.min_recv_ping_interval_without_data_ms", 4_000),
)


async def _requests(messages: AsyncIterator[bytes]) -> AsyncIterator[Request]:
    async for message in messages:
        yield read_request(message)


class _ClientGone(ClientLost):
    """The client disconnected while it was sent an answer."""


async def _write(context: Context, response: pb.StreamDepthResponse) -> None:
    try:
        await context.write(response)
    except (grpc.aio.InternalError, grpc.aio.UsageError):
        raise _ClientGone(
            "the client disconnected while it was sent an answer", reads=False
        ) from None


_Answer = tuple[type[Message], Callable[[Any, Principal], Awaitable[Message]]]


def _described() -> DescriptorPool:
    """Return the descriptions of all services; those of the inference protocol lie apart."""
    pool = DescriptorPool()

    def add(file: FileDescriptor) -> None:
        for each in file.dependencies:
            add(each)
        pool.AddSerializedFile(file.serialized_pb)

    for service in (pb, inference_pb2, health_pb2, reflection_pb2):
        add(service.DESCRIPTOR)
    return pool


def _host_of(peer: str) -> str:
    """Return the host in gRPC's ``ipv4:HOST:PORT``, ``ipv6:%5BHOST%5D:PORT`` or ``unix:PATH``."""
    _, _, address = unquote(peer).partition(":")
    return address.rpartition(":")[0].strip("[]")


class DepthServicer:
    """Translates each call to a call of the engine. It reads requests from bytes, within limits."""

    def __init__(self, unary: UnaryMethods, calls: OpenCalls) -> None:
        self.calls = calls
        self._by_peer: Counter[str] = Counter()  # open calls of each connection
        answers: dict[str, _Answer] = {
            "GetServerInfo": (pb.GetServerInfoRequest, unary.server_info),
            "GetStream": (pb.GetStreamRequest, unary.stream),
            "ResetStream": (pb.ResetStreamRequest, unary.reset),
            "CloseStream": (pb.CloseStreamRequest, unary.close),
        }
        self.handlers: dict[str, grpc.RpcMethodHandler[Any, Any]] = {
            "StreamDepth": grpc.stream_stream_rpc_method_handler(
                self._stream_depth, response_serializer=pb.StreamDepthResponse.SerializeToString
            ),
            **{name: _unary(*answer) for name, answer in answers.items()},
        }

    async def _stream_depth(self, messages: AsyncIterator[bytes], context: Context) -> None:
        async with errors_as_status(context):
            peer = context.peer()
            write = partial(_write, context)
            call = self.calls.make(
                _requests(messages), write, client=_host_of(peer), caller=CALLER.get()
            )
            self._by_peer[peer] += 1
            try:
                await self.calls.run(call)
            except _ClientGone as gone:
                log.info("a call over gRPC has ended: %s", gone)
                raise asyncio.CancelledError from None  # gRPC takes it as the end of the call
            except ClientLost as lost:
                log.info("a call over gRPC counts as lost: %s", lost)
                await hang_up(context, str(lost), reads=lost.reads, shared=self._by_peer[peer] > 1)
            finally:
                self._by_peer[peer] -= 1
                if not self._by_peer[peer]:
                    del self._by_peer[peer]


def _unary(
    question: type[Message], answer: Callable[[Any, Principal], Awaitable[Message]]
) -> "grpc.RpcMethodHandler[Any, Any]":
    async def handle(request: bytes, context: Context) -> bytes:
        async with errors_as_status(context):
            return (await answer(read_small(question, request), CALLER.get())).SerializeToString()

    return grpc.unary_unary_rpc_method_handler(handle)


class GrpcServer:
    """Listens as long as its context lasts. Clients see it as healthy after :meth:`serving`.

    Entering the context raises PortTaken if the server cannot listen on the address.
    """

    def __init__(
        self,
        servicer: DepthServicer,
        inference: InferenceServicer,
        *,
        host: str,
        port: int,
        max_frame_bytes: int,
        max_connections: int,
        first_message_s: float,
        gate: Gate,
        certificate: Certificate | None = None,
    ) -> None:
        self._gate = gate
        self._certificate = certificate
        self._servicer = servicer
        self._inference = inference
        self._host = host
        self._max_connections = max_connections
        self._first_message_s = first_message_s
        self._max_message_bytes = int(max_frame_bytes * _ROOM_OVER_THE_LIMIT)
        self._health = health.aio.HealthServicer()  # type: ignore[attr-defined] # bound at import
        self.port = port

    async def __aenter__(self) -> Self:
        self._server = grpc.aio.server(
            interceptors=[
                Identity(self._gate),
                FirstMessageDeadline(self._first_message_s),
                SmallRequests(),
            ],
            maximum_concurrent_rpcs=self._max_connections + _MORE_CALLS,
            options=[
                # On by default, two servers would share the port and split streams silently.
                ("grpc.so_reuseport", 0),
                ("grpc.max_receive_message_length", self._max_message_bytes),
                ("grpc.max_send_message_length", self._max_message_bytes),
                ("grpc.max_allowed_incoming_connections", self._max_connections),
                ("grpc.max_concurrent_streams", _CALLS_OF_A_CONNECTION),
                ("grpc.compression_enabled_algorithms_bitset", _ONLY_IDENTITY),
                ("grpc.server_handshake_timeout_ms", int(1000 * self._first_message_s)),
                *_KEEPALIVE,
            ],
        )
        self._server.add_generic_rpc_handlers(
            [
                grpc.method_handlers_generic_handler(_SERVICE, self._servicer.handlers),
                grpc.method_handlers_generic_handler(INFERENCE_SERVICE, self._inference.handlers),
            ]
        )
        health_pb2_grpc.add_HealthServicer_to_server(self._health, self._server)
        reflection.enable_server_reflection(
            [_SERVICE, INFERENCE_SERVICE, health.SERVICE_NAME, reflection.SERVICE_NAME],
            self._server,
            _described(),
        )
        await self._set_health(health_pb2.HealthCheckResponse.NOT_SERVING)
        # gRPC's own error does not say why, and it writes a second one to stderr.
        listening_socket(self._host, self.port, transport="grpc").close()
        address = format_address(self._host, self.port)
        try:
            self.port = (
                self._server.add_insecure_port(address)
                if self._certificate is None
                else self._server.add_secure_port(address, self._certificate.grpc_credentials())
            )
        except RuntimeError as error:
            raise PortTaken(address, "grpc", OSError(str(error))) from None
        await self._server.start()
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        await self._server.stop(grace=None)

    async def serving(self) -> None:
        """Report SERVING in the health service."""
        await self._set_health(health_pb2.HealthCheckResponse.SERVING)

    async def drain(self, *, within_s: float) -> None:
        """Wait until all calls end; after ``within_s``, answer what they have sent and end them."""
        await self._set_health(health_pb2.HealthCheckResponse.NOT_SERVING)
        await self._servicer.calls.drain(within_s=within_s)
        await self._server.stop(grace=FINISHING_SHARE * within_s)

    async def _set_health(self, status: health_pb2.HealthCheckResponse.ServingStatus) -> None:
        for service in ("", _SERVICE):
            await self._health.set(service, status)
