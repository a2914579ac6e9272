"""The connection of one stream: opened, kept alive, and reopened when it breaks."""

import asyncio
import random
import time
from collections.abc import Callable
from typing import Protocol

from vergence.results import EventKind, SessionEvent
from vergence.transports.base import Call, ConnectionLost, Transport
from vergence_proto.errors import NotReady
from vergence_proto.v1 import depth_pb2 as pb

RESET = pb.StreamDepthRequest(reset=pb.Reset()).SerializeToString()
_END = pb.StreamDepthRequest(end=pb.End()).SerializeToString()

_OPEN_TIMEOUT_S = 5.0
_CLOSE_TIMEOUT_S = 2.0
_PING_INTERVAL_S = 1.0
_FIRST_RETRY_S, _LAST_RETRY_S = 0.05, 1.0

_NOTICES = {
    pb.NOTICE_KIND_DRAINING: EventKind.DRAINING,
    pb.NOTICE_KIND_EXPIRING: EventKind.EXPIRING,
}


class StreamListener(Protocol):
    """Receives what arrives on a :class:`StreamConnection`; no method may block."""

    def attached(self, opened: pb.StreamOpened) -> list[bytes]:
        """The stream is open, or open again; returns what must be sent again."""

    def detached(self, lost: ConnectionLost) -> None:
        """The connection broke; the stream may be open again later."""

    def answered(self, response: pb.StreamDepthResponse) -> None:
        """A response about a frame arrived."""

    def ended(self, error: Exception | None) -> None:
        """No response follows; ``error`` is None if the session asked for the end."""


class StreamConnection:
    """Attach to one stream, and resume it with its token for as long as the server keeps it."""

    def __init__(
        self,
        transport: Transport,
        opening: pb.OpenStream,
        listener: StreamListener,
        on_event: Callable[[SessionEvent], None] | None,
    ) -> None:
        self._transport = transport
        self._opening = opening
        self._listener = listener
        self._on_event = on_event
        self._outbox: asyncio.Queue[bytes] = asyncio.Queue()
        self._ending = False
        self.up: bool = False  # True: a frame that is sent now leaves at once
        self.round_trip_s: float | None = None

    @property
    def ending(self) -> bool:
        """Return True once the end was requested or has come."""
        return self._ending

    async def open(self) -> None:
        """Attach, and reattach in the background until :meth:`close`."""
        call = await self._attach()
        name = f"vergence stream {self._opening.stream_id}"
        self._runner = asyncio.create_task(self._run(call), name=name)

    async def close(self) -> None:
        """Wait for the last answers, at most two seconds, and close."""
        self.end()
        try:
            await asyncio.wait({self._runner}, timeout=_CLOSE_TIMEOUT_S)
        finally:
            self._runner.cancel()
            await asyncio.gather(self._runner, return_exceptions=True)

    def send(self, request: bytes) -> None:
        """Queue a ``pb.StreamDepthRequest``, serialized."""
        self._outbox.put_nowait(request)

    def end(self) -> None:
        """Request the end of the stream, once."""
        if not self._ending:
            self._ending = True
            self.send(_END)

    async def _run(self, call: Call) -> None:
        error: Exception | None = ConnectionLost("the session was closed")
        try:
            while (lost := await self._converse(call)) is not None:
                call = await self._resume(lost)
            error = None
        except Exception as fatal:  # whatever it is, every waiting step must raise it
            error = fatal
        finally:
            self._ending = True
            self._listener.ended(error)

    async def _converse(self, call: Call) -> ConnectionLost | None:
        """Send and receive until the call ends; None if the end was requested, else the failure."""
        helpers = [asyncio.create_task(self._send_all(call)), asyncio.create_task(self._ping())]
        try:
            while (response := await call.receive()) is not None:
                self._take(response)
        except ConnectionLost as lost:
            return lost
        finally:
            self.up = False
            for helper in helpers:
                helper.cancel()
            await asyncio.gather(*helpers, return_exceptions=True)
            await call.close()
        return None if self._ending else ConnectionLost("the server ended the call")

    async def _send_all(self, call: Call) -> None:
        while True:
            await call.send(await self._outbox.get())

    async def _ping(self) -> None:
        while True:
            ping = pb.Ping(client_ns=time.monotonic_ns())
            self.send(pb.StreamDepthRequest(ping=ping).SerializeToString())
            await asyncio.sleep(_PING_INTERVAL_S)

    async def _attach(self) -> Call:
        call = await self._transport.open_call(self._opening.stream_id)
        try:
            async with asyncio.timeout(_OPEN_TIMEOUT_S):
                await call.send(pb.StreamDepthRequest(open=self._opening).SerializeToString())
                response = await call.receive()
            if response is None or not response.HasField("opened"):
                raise NotReady(f"expected the server to open the stream, got {response}")
            self._opening.resume_token = response.opened.resume_token
            self._opening.weights_sha256 = response.opened.model.weights_sha256
            self._grace_s = response.opened.detach_grace_s
            resend = self._listener.attached(response.opened)
        except TimeoutError:
            await call.close()
            raise ConnectionLost(f"the server did not answer in {_OPEN_TIMEOUT_S:g} s") from None
        except BaseException:
            await call.close()
            raise
        # Requests queued for the broken connection are in `resend`, or too old to be sent.
        self._outbox = asyncio.Queue()
        for request in resend:
            self.send(request)
        if self._ending:
            self.send(_END)
        self.up = True
        return call

    async def _resume(self, lost: ConnectionLost) -> Call:
        self._listener.detached(lost)
        self._report(SessionEvent(EventKind.DISCONNECTED, str(lost)))
        started, delay_s = time.monotonic(), _FIRST_RETRY_S
        while True:
            try:
                call = await self._attach()
            except NotReady as error:
                if time.monotonic() + delay_s - started > self._grace_s:
                    raise ConnectionLost(
                        f"could not reach the server again in {self._grace_s:g} s, after which it "
                        f"discards the stream; open a new session ({error})"
                    ) from error
            else:
                away_s = time.monotonic() - started
                self._report(SessionEvent(EventKind.RESUMED, f"resumed after {away_s:.2f} s"))
                return call
            # Half of the delay is random, so that clients do not all reconnect at once.
            await asyncio.sleep(delay_s * random.uniform(0.5, 1.0))
            delay_s = min(2 * delay_s, _LAST_RETRY_S)

    def _take(self, response: pb.StreamDepthResponse) -> None:
        match response.WhichOneof("message"):
            case "pong":
                pong = response.pong
                elapsed_ns = time.monotonic_ns() - pong.client_ns - pong.server_hold_ns
                self.round_trip_s = elapsed_ns * 1e-9
            case "notice" if response.notice.kind in _NOTICES:
                notice = response.notice
                self._report(SessionEvent(_NOTICES[notice.kind], notice.message, notice.in_s))
            case _:
                self._listener.answered(response)

    def _report(self, event: SessionEvent) -> None:
        if self._on_event is not None:
            self._on_event(event)
