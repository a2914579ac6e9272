"""The StreamDepth calls that are open on one transport."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable

from vergence_proto.codec import Request
from vergence_proto.errors import DepthError, Draining
from vergence_proto.v1 import depth_pb2 as pb
from vergence_service.access.principals import Principal
from vergence_service.process.memory import MemoryBudget
from vergence_service.streams.engine import DepthEngine
from vergence_service.transports.stream_call import ClientLost, DepthCall, StreamLimits

# A drain takes at most twice its time: once for clients to leave, and this share of it for the
# answers to what they have sent. The rest is for the server to end.
FINISHING_SHARE = 0.75


class OpenCalls:
    """Makes calls, keeps track of those that run, and ends them when the server drains."""

    def __init__(
        self,
        engine: DepthEngine,
        *,
        transport: str,
        limits: StreamLimits,
        clock: Callable[[], float],
    ) -> None:
        self._transport = transport
        self.limits = limits
        self._engine = engine
        self._clock = clock
        self._running: set[DepthCall] = set()
        self._idle = asyncio.Event()
        self._idle.set()

    def make(
        self,
        requests: AsyncIterator[Request],
        write: Callable[[pb.StreamDepthResponse], Awaitable[None]],
        *,
        client: str,
        caller: Principal,
    ) -> DepthCall:
        """Make a call. ``client`` is the address it comes from, or empty if that is unknown."""
        return DepthCall(
            self._engine,
            requests,
            write,
            client=client,
            caller=caller,
            transport=self._transport,
            limits=self.limits,
            clock=self._clock,
        )

    @property
    def memory(self) -> MemoryBudget:
        """The budget of everything that clients make the server keep."""
        return self._engine.memory

    async def run(self, call: DepthCall) -> None:
        """Serve the call to its end. Raises the DepthError that it ends with, or ClientLost."""
        self._running.add(call)
        self._engine.metrics.calls_open.inc()
        self._idle.clear()
        reason = "left"  # the task was cancelled: the client is gone
        try:
            await call.run()
            reason = "done"
        except DepthError as error:
            reason = error.code
            raise
        except ClientLost:
            reason = "lost"
            raise
        finally:
            self._engine.metrics.calls_ended.labels(self._transport, reason).inc()
            self._running.discard(call)
            self._engine.metrics.calls_open.dec()
            if not self._running:
                self._idle.set()

    async def drain(self, *, within_s: float) -> None:
        """Wait until all calls end; after ``within_s``, answer what they have sent and end them."""
        try:
            async with asyncio.timeout(within_s):
                await self._idle.wait()
        except TimeoutError:
            for call in self._running:
                call.finish(Draining("the server is shutting down; continue on another one"))
