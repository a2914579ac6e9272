"""The gRPC transport: one HTTP/2 connection per stream, and one for unary methods."""

import asyncio
import contextlib
from collections.abc import Callable
from typing import cast

import grpc
from google.protobuf.message import Message
from grpc_status import rpc_status

from vergence.transports.base import Answer, Call, ClientClosed, ConnectionLost
from vergence.transports.credentials import Credentials
from vergence.transports.forks import use_grpc
from vergence.transports.proxies import through_proxy
from vergence_proto import codec
from vergence_proto.errors import DepthError, FrameTooLarge, NotReady
from vergence_proto.v1 import depth_pb2 as pb
from vergence_proto.zenoh.keys import STREAM_ID_METADATA

_SERVICE = "/vergence.v1.DepthService/"
_ASK_TIMEOUT_S = 10.0
# The details that gRPC invents when a call ends during a write, see _GrpcCall._keep_status.
_WRITE_FAILED = "Internal error from Core"
_STATUS_TIMEOUT_S = 1.0

_CHANNEL_OPTIONS = (
    # Images exceed gRPC's default of 4 MiB; the server has a limit of its own.
    ("grpc.max_send_message_length", -1),
    ("grpc.max_receive_message_length", -1),
    # Without these, a server that vanished silently would be noticed after two hours.
    ("grpc.keepalive_time_ms", 10_000),
    ("grpc.keepalive_timeout_ms", 5_000),
    # gRPC itself waits 1 s to 2 min between attempts and fails every call made meanwhile.
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.max_reconnect_backoff_ms", 500),
    # Despite its name this is the time in which an attempt must connect, two round trips. Callers
    # have shorter timeouts of their own.
    ("grpc.min_reconnect_backoff_ms", 20_000),
    # Otherwise the channels of one process share one connection and its backoff.
    ("grpc.use_local_subchannel_pool", 1),
)


class GrpcTransport:
    """The :class:`~vergence.transports.base.Transport` to one ``host:port``.

    ``direct``: without the web proxy that the environment may name. ``secure``: over TLS.
    Raises ConnectionLost: the process was forked after gRPC was used.
    """

    def __init__(
        self,
        address: str,
        *,
        direct: bool = False,
        secure: bool = False,
        credentials: Credentials | None = None,
    ) -> None:
        use_grpc()
        shown = credentials or Credentials()
        self._metadata = tuple(shown.headers.items())
        self._tls = _tls_of(shown) if secure else None
        self._address = address
        self._options = (*_CHANNEL_OPTIONS, ("grpc.enable_http_proxy", int(not direct)))
        self._through = "" if direct else through_proxy(f"grpc://{address}")
        self._channel = self._connection()
        self._closed = False
        self._calls: set[_GrpcCall] = set()

    async def open_call(self, stream_id: str) -> Call:
        # A channel of its own, because a new one can connect while TCP still waits for the old.
        if self._closed:
            raise ClientClosed
        channel = self._connection()
        start = channel.stream_stream(
            f"{_SERVICE}StreamDepth",
            request_serializer=bytes,  # requests are serialized already
            response_deserializer=pb.StreamDepthResponse.FromString,
        )
        started = start(
            request_iterator=None, metadata=((STREAM_ID_METADATA, stream_id), *self._metadata)
        )
        call = _GrpcCall(channel, started, self._address, self._through)
        try:
            await call.connected()
        except BaseException:
            await call.close()
            raise
        self._calls.add(call)
        call.closed = self._calls.discard
        return call

    def _connection(self) -> grpc.aio.Channel:
        if self._tls is None:
            return grpc.aio.insecure_channel(self._address, options=self._options)
        return grpc.aio.secure_channel(self._address, self._tls, options=self._options)

    async def ask(self, method: str, request: Message, answer: type[Answer]) -> Answer:
        invoke = self._channel.unary_unary(
            f"{_SERVICE}{method}",
            request_serializer=type(request).SerializeToString,
            response_deserializer=answer.FromString,
        )
        try:
            response: Answer = await invoke(
                request, timeout=_ASK_TIMEOUT_S, metadata=(*_stream_of(request), *self._metadata)
            )
        except grpc.aio.AioRpcError as error:
            raise _error_from_rpc(error, self._address, self._through) from None
        return response

    async def close(self) -> None:
        self._closed = True
        await self._channel.close(grace=None)
        for call in list(self._calls):
            await call.close()


def _stream_of(request: Message) -> tuple[tuple[str, str], ...]:
    """Return the metadata that leads a question about a stream to the server of the stream."""
    stream_id = getattr(request, "stream_id", "")
    return ((STREAM_ID_METADATA, stream_id),) if stream_id else ()


def _tls_of(credentials: Credentials) -> grpc.ChannelCredentials:
    ca, key, cert = (
        None if file is None else file.read_bytes()
        for file in (credentials.ca, credentials.key, credentials.cert)
    )
    return grpc.ssl_channel_credentials(ca, key, cert)


class _GrpcCall:
    def __init__(
        self,
        channel: grpc.aio.Channel,
        call: "grpc.aio.StreamStreamCall[bytes, pb.StreamDepthResponse]",
        address: str,
        through: str,
    ) -> None:
        self.closed: Callable[[_GrpcCall], None] = _nothing
        self._channel = channel
        self._call = call
        self._responses = aiter(call)
        self._address = address
        self._through = through
        self._status: asyncio.Future[grpc.aio.AioRpcError]
        self._status = asyncio.get_running_loop().create_future()
        call.add_done_callback(self._keep_status)

    async def connected(self) -> None:
        try:
            await self._call.wait_for_connection()
        except grpc.aio.AioRpcError as error:
            raise _error_from_rpc(error, self._address, self._through) from None

    async def send(self, request: bytes) -> None:
        # Both errors mean that the call has ended, before this write or during it.
        with contextlib.suppress(asyncio.InvalidStateError, grpc.aio.AioRpcError):
            await self._call.write(request)

    async def receive(self) -> pb.StreamDepthResponse | None:
        try:
            # Not read(): after a failed write it skips the messages that have arrived, and the
            # status comes behind them.
            return await anext(self._responses, None)
        except grpc.aio.AioRpcError as error:
            why = await self._why_ended(error)
            if why.code() is grpc.StatusCode.OK:  # it ended during a write
                return None
            raise _error_from_rpc(why, self._address, self._through) from None
        except asyncio.CancelledError:
            # gRPC raises it also if the channel was closed and nobody cancelled this task.
            task = asyncio.current_task()
            if task is not None and task.cancelling():
                raise
            raise ConnectionLost(f"the connection to {self._address} was closed") from None

    async def close(self) -> None:
        self._call.cancel()
        self.closed(self)
        await self._channel.close(grace=None)

    async def _why_ended(self, error: grpc.aio.AioRpcError) -> grpc.aio.AioRpcError:
        try:
            return await asyncio.wait_for(self._status, _STATUS_TIMEOUT_S)
        except TimeoutError:
            return error

    def _keep_status(self, call: object) -> None:
        """Keep the server's status.

        If the call ends during a write, gRPC reports an INTERNAL status of its own instead of the
        server's, which may arrive a moment later (grpc/grpc#36066).
        """
        status = _status_of(self._call)
        if status.details() != _WRITE_FAILED and not self._status.done():
            self._status.set_result(status)


def _nothing(call: _GrpcCall) -> None:
    """Do nothing: the call is in no list yet."""


def _status_of(
    call: "grpc.aio.StreamStreamCall[bytes, pb.StreamDepthResponse]",
) -> grpc.aio.AioRpcError:
    """Return the status of a call that has ended; nothing is pending, so no await is needed."""

    async def read() -> grpc.aio.AioRpcError:
        metadata = await call.trailing_metadata()
        code, details = await call.code(), await call.details()
        return grpc.aio.AioRpcError(code, grpc.aio.Metadata(), metadata, details, None)

    reading = read()
    try:
        reading.send(None)
    except StopIteration as end:
        return cast(grpc.aio.AioRpcError, end.value)
    reading.close()
    raise AssertionError("the status of a call that has ended is known")


def _error_from_rpc(error: grpc.aio.AioRpcError, address: str, through: str) -> DepthError:
    """Return the error that the server raised, by its ErrorInfo, else a connection error."""
    status = rpc_status.from_call(cast(grpc.Call, error))  # it has every method that is used
    ours = codec.error_from_status(status) if status is not None else None
    if ours is not None:
        return ours
    code, details = error.code(), error.details()
    if code is grpc.StatusCode.RESOURCE_EXHAUSTED:  # gRPC's own limit on a message
        return FrameTooLarge(
            f"{address} refused the message: {details}; the server's setting limits.max_frame_mib "
            "allows more"
        )
    if code is grpc.StatusCode.UNIMPLEMENTED:
        return NotReady(f"{address} speaks gRPC but does not offer vergence.v1: {details}")
    # Only the end of gRPC's sentence is informative.
    reason = (details or code.name).rpartition("last error: ")[2].removeprefix("UNKNOWN: ")
    return ConnectionLost(f"no connection to {address}{through}: {reason}")
