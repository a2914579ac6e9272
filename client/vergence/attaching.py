"""Attach to a stream on the server, and decide what to do when that fails."""

import asyncio
import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from vergence.dialing import dial, pauses
from vergence.results import EventKind, SessionEvent
from vergence.transports.base import Call, ClientClosed, ConnectionLost, Transport
from vergence_proto.errors import (
    DepthError,
    Draining,
    ModelChanged,
    NotReady,
    Quota,
    StateMemory,
    StreamExpired,
    StreamLimit,
    UnknownStream,
)
from vergence_proto.v1 import depth_pb2 as pb

OnLost = Literal["restart", "raise"]

_GONE = (UnknownStream, StreamExpired, ModelChanged)
_NO_ROOM = (Quota, StreamLimit, StateMemory)
_LAST_ATTEMPT_S = 0.2  # with less time left, waiting for room ends
_ANSWER_TIMEOUT_S = 5.0  # from the opening to its answer, on a connection that is up
# The same for the first attempt to resume. A load balancer may not know yet that the stream's
# server hangs, and leads the next attempt to another one.
_FIRST_RESUME_S = 1.5


@dataclass(frozen=True, slots=True)
class RecoveryRules:
    """The choices of a session about what ends it."""

    on_lost: OnLost = "restart"
    open_timeout_s: float = 10.0


class StreamAttacher:
    """Attaches calls to one stream, or to the new stream that takes its place.

    Only the server decides that a state is gone, so an attempt is repeated until the server
    answers it.
    """

    def __init__(
        self,
        transport: Transport,
        opening: pb.OpenStream,
        rules: RecoveryRules,
        report: Callable[[SessionEvent], None],
    ) -> None:
        self._transport = transport
        self._opening = opening
        self._rules = rules
        self._report = report
        self._pinned_sha256 = opening.weights_sha256
        self._refusal: DepthError | None = None  # the latest reason for another attempt
        self.unsure: bool = False  # an attachment of ours may reach the server after a later one
        self.gone: DepthError | None = None  # the reason why the next stream is a new one
        self.opened: pb.StreamOpened | None = None  # None: the stream was never open
        opening.opening_id = secrets.token_bytes(16)

    async def open(self) -> Call:
        """Attach for the first time, within ``open_timeout_s``. Raises the latest error."""
        limit_s = self._rules.open_timeout_s
        try:
            return await self._within(limit_s, None)
        except TimeoutError:
            raise self._refusal or ConnectionLost(
                f"the server did not answer in {limit_s:g} s"
            ) from None

    async def reopen(self, call: Call | None) -> Call:
        """Attach again; ``call`` is a connection that is up already.

        Raises ConnectionLost when no server can have the stream any more, if the rules say so.
        """
        if self._rules.on_lost == "restart" or self.opened is None:
            return await self._attached(call)
        # A server that did not notice the loss expires the stream, because no frame comes.
        limit_s = self.opened.idle_timeout_s + self.opened.detach_grace_s
        try:
            return await self._within(limit_s, call)
        except TimeoutError:
            raise ConnectionLost(
                f"could not reach the server again in {limit_s:g} s, after which it has discarded "
                f"the stream; open a new session ({self._refusal})"
            ) from None

    async def dial(self) -> Call:
        """Connect, to attach later. Tries for ever."""
        return await dial(self._transport, self._opening.stream_id, failed=self._failed)

    def must_raise(self, error: DepthError) -> bool:
        """Return True if the rules say to raise what ended a call, instead of attaching again."""
        if isinstance(error, ConnectionLost):
            return False
        if isinstance(error, ModelChanged) and self._pinned_sha256:
            return True
        return self._rules.on_lost == "raise" or self.opened is None

    def forget(self, gone: DepthError) -> None:
        """Let the next attachment open a new stream under the same id."""
        self.gone = gone
        self._opening.resume_token = b""
        self._opening.opening_id = secrets.token_bytes(16)
        self._opening.weights_sha256 = self._pinned_sha256

    async def _within(self, limit_s: float, call: Call | None) -> Call:
        async with asyncio.timeout(limit_s):
            return await self._attached(call)

    async def _attached(self, call: Call | None) -> Call:
        waits = pauses()
        refused_s: float | None = None  # since this time the server has had no room
        patience_s = _ANSWER_TIMEOUT_S if self.opened is None else _FIRST_RESUME_S
        while True:
            try:
                call = call or await self.dial()
                answer_within_s, patience_s = patience_s, _ANSWER_TIMEOUT_S
                await self._attach(call, within_s=answer_within_s)
                return call
            except ClientClosed:
                raise
            except _NO_ROOM as error:
                refused_s = refused_s or time.monotonic()
                left_s = refused_s + self._rules.open_timeout_s - time.monotonic()
                if left_s < _LAST_ATTEMPT_S:
                    raise
                # Room may come earlier than announced, if another stream ends.
                wait_s = min(error.retry_after_s or next(waits), left_s / 2)
                self._refusal = error
                self._report(SessionEvent(EventKind.WAITING, str(error), wait_s))
            except (NotReady, Draining) as error:
                if self.opened is not None and self.must_raise(error):
                    raise
                self._refusal = error
                wait_s = error.retry_after_s or next(waits)
            except _GONE as error:
                if self.must_raise(error):
                    raise
                self.forget(error)
                wait_s = 0.0
            call = None
            await asyncio.sleep(wait_s)

    async def _attach(self, call: Call, *, within_s: float) -> None:
        try:
            async with asyncio.timeout(within_s):
                await call.send(pb.StreamDepthRequest(open=self._opening).SerializeToString())
                response = await call.receive()
            if response is None or not response.HasField("opened"):
                raise NotReady(f"expected the server to open the stream, got {response}")
        except TimeoutError:
            self.unsure = True
            await call.close()
            raise ConnectionLost(f"the server did not answer in {within_s:g} s") from None
        except BaseException:
            await call.close()
            raise
        self.opened = response.opened
        self._opening.resume_token = response.opened.resume_token
        self._opening.weights_sha256 = response.opened.model.weights_sha256

    def _failed(self, lost: ConnectionLost) -> None:
        self._refusal = lost
