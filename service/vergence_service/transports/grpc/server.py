"""vergence.v1.DepthService over grpc.aio, with the standard health and reflection services."""

from collections.abc import AsyncIterator
from typing import Self
from urllib.parse import unquote

import grpc
from google.protobuf.message import DecodeError
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from vergence_proto.errors import BadShape
from vergence_proto.v1 import depth_pb2 as pb
from vergence_proto.v1 import depth_pb2_grpc
from vergence_service.transports.addresses import format_address, listening_socket
from vergence_service.transports.errors import PortTaken
from vergence_service.transports.grpc.errors import Context, errors_as_status
from vergence_service.transports.open_calls import OpenCalls
from vergence_service.transports.unary import UnaryMethods

_SERVICE = pb.DESCRIPTOR.services_by_name["DepthService"].full_name

# A frame just above the limit is still received, so that the error can name the limit.
_ROOM_OVER_THE_LIMIT = 1.25

# A client that vanished is noticed within 15 s instead of gRPC's two hours. Clients may ping every
# 5 s.
_KEEPALIVE = (
    ("grpc.keepalive_time_ms", 10_000),
    ("grpc.keepalive_timeout_ms", 5_000),
    ("grpc.keepalive_permit_without_calls", 1),
    ("grpc.http2.min_recv_ping_interval_without_data_ms", 4_000),
)


async def _messages(
    requests: AsyncIterator[pb.StreamDepthRequest],
) -> AsyncIterator[pb.StreamDepthRequest]:
    try:
        async for request in requests:
            yield request
    except DecodeError:
        raise BadShape("expected messages of vergence.v1, got other bytes") from None


def _host_of(peer: str) -> str:
    """Return the host in gRPC's ``ipv4:HOST:PORT``, ``ipv6:%5BHOST%5D:PORT`` or ``unix:PATH``."""
    _, _, address = unquote(peer).partition(":")
    return address.rpartition(":")[0].strip("[]")


class DepthServicer(depth_pb2_grpc.DepthServiceServicer):
    """Translates each call to a call of the engine."""

    def __init__(self, unary: UnaryMethods, calls: OpenCalls) -> None:
        self._unary = unary
        self.calls = calls

    async def StreamDepth(  # noqa: N802 -- the wire's name
        self, request_iterator: AsyncIterator[pb.StreamDepthRequest], context: Context
    ) -> None:
        async with errors_as_status(context):
            requests = _messages(request_iterator)
            client = _host_of(context.peer())
            await self.calls.run(self.calls.make(requests, context.write, client=client))

    async def GetServerInfo(  # noqa: N802
        self, request: pb.GetServerInfoRequest, context: Context
    ) -> pb.GetServerInfoResponse:
        async with errors_as_status(context):
            return await self._unary.server_info(request)

    async def GetStream(  # noqa: N802
        self, request: pb.GetStreamRequest, context: Context
    ) -> pb.GetStreamResponse:
        async with errors_as_status(context):
            return await self._unary.stream(request)

    async def ResetStream(  # noqa: N802
        self, request: pb.ResetStreamRequest, context: Context
    ) -> pb.ResetStreamResponse:
        async with errors_as_status(context):
            return await self._unary.reset(request)

    async def CloseStream(  # noqa: N802
        self, request: pb.CloseStreamRequest, context: Context
    ) -> pb.CloseStreamResponse:
        async with errors_as_status(context):
            return await self._unary.close(request)


class GrpcServer:
    """Listens as long as its context lasts. Clients see it as healthy after :meth:`serving`.

    Entering the context raises PortTaken if the server cannot listen on the address.
    """

    def __init__(
        self, servicer: DepthServicer, *, host: str, port: int, max_frame_bytes: int
    ) -> None:
        self._servicer = servicer
        self._host = host
        self._max_message_bytes = int(max_frame_bytes * _ROOM_OVER_THE_LIMIT)
        self._health = health.aio.HealthServicer()  # type: ignore[attr-defined] # bound at import
        self.port = port

    async def __aenter__(self) -> Self:
        self._server = grpc.aio.server(
            options=[
                # On by default, two servers would share the port and split streams silently.
                ("grpc.so_reuseport", 0),
                ("grpc.max_receive_message_length", self._max_message_bytes),
                ("grpc.max_send_message_length", self._max_message_bytes),
                *_KEEPALIVE,
            ]
        )
        depth_pb2_grpc.add_DepthServiceServicer_to_server(self._servicer, self._server)
        health_pb2_grpc.add_HealthServicer_to_server(self._health, self._server)
        reflection.enable_server_reflection(
            [_SERVICE, health.SERVICE_NAME, reflection.SERVICE_NAME], self._server
        )
        await self._set_health(health_pb2.HealthCheckResponse.NOT_SERVING)
        # gRPC's own error does not say why, and it writes a second one to stderr.
        listening_socket(self._host, self.port, transport="grpc").close()
        address = format_address(self._host, self.port)
        try:
            self.port = self._server.add_insecure_port(address)
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
        await self._server.stop(grace=within_s)

    async def _set_health(self, status: health_pb2.HealthCheckResponse.ServingStatus) -> None:
        for service in ("", _SERVICE):
            await self._health.set(service, status)
