"""The connection of one stream: opened, watched, and replaced when it breaks or falls silent."""

import asyncio
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any, Protocol

from vergence.attaching import RecoveryRules, StreamAttacher
from vergence.link import SessionLink
from vergence.results import EventKind, SessionEvent, SessionState
from vergence.silence import Silence
from vergence.transports.base import Call, ConnectionLost, Transport
from vergence_proto.errors import (
    DepthError,
    Draining,
    NotReady,
    StreamExpired,
    Superseded,
    UnknownStream,
)
from vergence_proto.v1 import depth_pb2 as pb


@dataclass(frozen=True, slots=True, eq=False)
class FrameRequest:
    """A frame to send."""

    frame_id: int
    content: Callable[[], Awaitable[bytes | None]]
    """Make the serialized request when its turn has come; None: the frame is not wanted."""


Request = bytes | FrameRequest
"""A serialized ``pb.StreamDepthRequest``, or a frame."""

RESET = pb.StreamDepthRequest(reset=pb.Reset()).SerializeToString()
_END = pb.StreamDepthRequest(end=pb.End()).SerializeToString()
_PING = pb.StreamDepthRequest(ping=pb.Ping()).SerializeToString()  # its time is that of sending

_CLOSE_TIMEOUT_S = 2.0
_LOOK_INTERVAL_S = 0.1

# A stream that was resumed in time starts cold all the same if its next frame is too far away.
_TOO_FAR = {
    pb.ORIGIN_RESET_GAP: "too much time has passed",
    pb.ORIGIN_RESET_POSE_JUMP: "the camera has moved too far",
}

_NOTICES = {
    pb.NOTICE_KIND_DRAINING: EventKind.DRAINING,
    pb.NOTICE_KIND_EXPIRING: EventKind.EXPIRING,
}


class StreamListener(Protocol):
    """Receives what arrives on a :class:`StreamConnection`; no method may block."""

    def attached(self, opened: pb.StreamOpened) -> list[Request]:
        """The stream is open, or open again; returns what must be sent again."""

    def detached(self, lost: ConnectionLost) -> None:
        """The connection is lost; the stream may be open again later."""

    async def answered(self, response: pb.StreamDepthResponse) -> None:
        """A response about a frame arrived; the next one waits for this."""

    def ended(self, error: Exception | None) -> None:
        """No response follows; ``error`` is None if the session asked for the end."""

    @property
    def awaited(self) -> bool:
        """True while a call waits for the answer to its frame."""


class StreamConnection:
    """Keeps one stream attached, until the end is requested or the stream cannot continue.

    A connection that breaks is replaced. One that falls silent is reported, and replaced when
    another one is up.
    """

    def __init__(
        self,
        transport: Transport,
        opening: pb.OpenStream,
        listener: StreamListener,
        on_event: Callable[[SessionEvent], None] | None,
        rules: RecoveryRules,
        link: SessionLink,
    ) -> None:
        self._link = link
        self._listener = listener
        self._on_event = on_event
        self._attacher = StreamAttacher(transport, opening, rules, self._report)
        self._name = f"vergence stream {opening.stream_id}"
        self._outbox: asyncio.Queue[Request] = asyncio.Queue()
        self._silence = Silence()
        self._ending = False
        self._resumed = False  # and no map has come since
        self.state: SessionState = SessionState.RECONNECTING

    @property
    def ending(self) -> bool:
        """Return True once the end was requested or has come."""
        return self._ending

    @property
    def round_trip_s(self) -> float | None:
        """Return the network time of the latest ping, there and back; None before the first."""
        return self._silence.round_trip_s

    async def open(self) -> None:
        """Attach, and reattach in the background until :meth:`close`."""
        call = await self._attacher.open()
        self._begin()
        self._runner = asyncio.create_task(self._run(call), name=self._name)

    async def close(self) -> None:
        """Wait for the last answers, at most two seconds if the server is there, and close."""
        self.end()
        try:
            if self.state is SessionState.LIVE:
                await asyncio.wait({self._runner}, timeout=_CLOSE_TIMEOUT_S)
        finally:
            self._runner.cancel()
            await asyncio.gather(self._runner, return_exceptions=True)

    def send(self, request: Request) -> None:
        """Queue a request."""
        self._silence.active()
        self._link.waiting += isinstance(request, FrameRequest)
        self._outbox.put_nowait(request)

    def end(self) -> None:
        """Request the end of the stream, once."""
        if not self._ending:
            self._ending = True
            self.send(_END)

    async def _run(self, first: Call) -> None:
        error: Exception | None = None
        call: Call | None = first
        try:
            while call is not None:
                call = await self._use(call)
        except Exception as fatal:  # whatever it is, every waiting step must raise it
            error = fatal
        finally:
            self._ending = True
            self.state = SessionState.ENDED
            self._listener.ended(error)

    async def _use(self, call: Call) -> Call | None:
        """Use a call for as long as it is good; return the next one, or None at the end."""
        talk = asyncio.create_task(self._talk(call))
        try:
            beside = await self._replacement(talk)
        finally:
            talk.cancel()
            await asyncio.gather(talk, return_exceptions=True)
        lost = talk.result() if beside is None else ConnectionLost("the server fell silent")
        if lost is None:
            return None
        if self._ending and not self._listener.awaited and beside is None:
            return None  # the server will drop the stream by itself
        return await self._reattach(lost, beside)

    async def _talk(self, call: Call) -> DepthError | None:
        """Send and receive until the call ends. Return why it was lost, None at the end.

        Raises the error that ends the stream.
        """
        helpers = [asyncio.create_task(self._send_all(call)), asyncio.create_task(self._ping())]
        try:
            while (response := await call.receive()) is not None:
                await self._take(response)
        except (NotReady, Draining, StreamExpired) as lost:
            if self._attacher.must_raise(lost):
                raise
            if isinstance(lost, StreamExpired):
                self._attacher.forget(lost)
            return lost
        except Superseded as lost:
            if not self._attacher.unsure:
                raise
            self._attacher.unsure = False
            return lost
        finally:
            for helper in helpers:
                helper.cancel()
            await asyncio.gather(*helpers, return_exceptions=True)
            await call.close()
        return None if self._ending else ConnectionLost("the server ended the call")

    async def _send_all(self, call: Call) -> None:
        while True:
            request = await self._outbox.get()
            if isinstance(request, FrameRequest):
                await self._send_frame(call, request)
            elif request == _PING:
                await self._send_ping(call)
            else:
                self._silence.sent(request)
                await call.send(request)

    async def _send_frame(self, call: Call, frame: FrameRequest) -> None:
        try:
            content = await frame.content()
            if content is None:
                return
            ping_ns: int | None = None
            if self._silence.ping_due:
                # Just before a frame, the ping measures how long the frame's bytes take.
                ping_ns = await self._send_ping(call)
            self._silence.sent(content)
            self._link.frame_sent(frame.frame_id, len(content), ping_ns=ping_ns)
            await call.send(content)
        finally:
            self._link.waiting -= 1

    async def _send_ping(self, call: Call) -> int:
        ping = pb.Ping(client_ns=time.monotonic_ns())
        self._silence.pinged(ping)
        await call.send(pb.StreamDepthRequest(ping=ping).SerializeToString())
        return ping.client_ns

    async def _ping(self) -> None:
        self._outbox.put_nowait(_PING)
        while True:
            # A frame takes the ping along, if one comes.
            await asyncio.sleep(self._silence.ping_interval_s / 2)
            if self._silence.ping_late:
                self._outbox.put_nowait(_PING)

    async def _replacement(self, talk: asyncio.Task[DepthError | None]) -> Call | None:
        """Wait for the end of a call; return another call if this one is silent for too long."""
        while True:
            await self._while(lambda: not self._silence.too_long, talk)
            if talk.done():
                return None
            self.state = SessionState.STALLED
            silent_s = self._silence.silent_s
            self._tell(EventKind.STALLED, f"no message from the server for {silent_s:.1f} s")
            await self._while(lambda: self._silence.too_long and not self._silence.hopeless, talk)
            if self._silence.too_long and (beside := await self._dialed_beside(talk)):
                self._silence.replaced()
                return beside
            if talk.done():
                return None
            self.state = SessionState.LIVE
            self._tell(EventKind.LIVE, "the server answers again")

    async def _dialed_beside(self, talk: asyncio.Task[DepthError | None]) -> Call | None:
        """Connect while another call is silent; None if that one is heard again, or ends."""
        dialing = asyncio.create_task(self._attacher.dial())
        try:
            await self._while(lambda: self._silence.too_long, talk, dialing)
            if self._silence.too_long and dialing.done() and not talk.done():
                return dialing.result()
        finally:
            if not dialing.done():
                dialing.cancel()
                await asyncio.gather(dialing, return_exceptions=True)
        if dialing.done() and not dialing.cancelled():
            await dialing.result().close()
        return None

    async def _while(self, condition: Callable[[], bool], *tasks: asyncio.Task[Any]) -> None:
        """Wait while the condition holds and no task is done."""
        while condition() and not any(task.done() for task in tasks):
            await asyncio.wait(tasks, timeout=_LOOK_INTERVAL_S, return_when=asyncio.FIRST_COMPLETED)

    async def _reattach(self, lost: DepthError, beside: Call | None) -> Call | None:
        started = time.monotonic()
        if self.state is SessionState.LIVE:
            self._tell(EventKind.DISCONNECTED, str(lost))
        self.state = SessionState.RECONNECTING
        self._listener.detached(
            lost if isinstance(lost, ConnectionLost) else ConnectionLost(str(lost))
        )
        try:
            call = await self._attacher.reopen(beside)
        except (UnknownStream, StreamExpired):
            if self._ending:  # the stream has ended as requested, and only the answer was lost
                return None
            raise
        away_s = time.monotonic() - started
        gone, self._attacher.gone = self._attacher.gone, None
        self._begin()
        self._resumed = gone is None
        if gone is None:
            self._tell(EventKind.RESUMED, f"resumed after {away_s:.2f} s")
        else:
            self._tell(
                EventKind.RESTARTED,
                f"restarted after {away_s:.2f} s; the stream's memory is lost: {gone}",
            )
        return call

    def _begin(self) -> None:
        """Start to use an attached call."""
        assert self._attacher.opened is not None
        # Requests queued for the last connection are sent again, or too old to be sent.
        self._outbox = asyncio.Queue()
        self._link.attached(self._attacher.opened)
        for request in self._listener.attached(self._attacher.opened):
            self.send(request)
        if self._ending:
            self.send(_END)
        self._silence.begin()
        self.state = SessionState.LIVE

    async def _take(self, response: pb.StreamDepthResponse) -> None:
        self._silence.heard(response)
        self._link.heard(response)
        match response.WhichOneof("message"):
            case "pong":
                pass
            case "notice" if response.notice.kind in _NOTICES:
                notice = response.notice
                self._tell(_NOTICES[notice.kind], notice.message, notice.in_s)
            case kind:
                if kind == "disparity":
                    self._tell_if_cold(response.disparity)
                await self._listener.answered(response)

    def _tell_if_cold(self, disparity: pb.DisparityMap) -> None:
        """Correct the report that the stream was resumed, if its first map does not show that."""
        resumed, self._resumed = self._resumed, False
        if resumed and (why := _TOO_FAR.get(disparity.origin)):
            self._tell(
                EventKind.RESTARTED,
                f"the stream's memory is lost: {why} between frame {disparity.frame_id} and the "
                "last one before it, so that it was a cold start",
            )

    def _tell(self, kind: EventKind, message: str, in_s: float = 0.0) -> None:
        self._report(SessionEvent(kind, message, in_s))

    def _report(self, event: SessionEvent) -> None:
        if self._on_event is not None:
            self._on_event(event)
