"""The answers of one connection that wait to be encoded and sent."""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace

from vergence_proto import codec
from vergence_proto.v1 import depth_pb2 as pb
from vergence_service.process.failures import out_of_memory
from vergence_service.process.metrics import Metrics
from vergence_service.process.threads import Cost, ThreadPool
from vergence_service.streams.conversion import SteppedFrame
from vergence_service.streams.stream import Notice, NoticeKind

# One map is encoded and sent while the next is stepped. Beyond that the stepper waits for the
# client to read, and newer frames displace older ones in the mailbox.
_UNSENT_MAPS = 2
# Limit for short answers to a client that does not read. Beyond it, its frames are not read either.
_ROOM = 64

_NOTICE = {
    NoticeKind.DRAINING: pb.NOTICE_KIND_DRAINING,
    NoticeKind.EXPIRING: pb.NOTICE_KIND_EXPIRING,
}


@dataclass(frozen=True, slots=True, eq=False)
class _Map:
    stepped: SteppedFrame
    map_step: int  # 0: the stream's


@dataclass(frozen=True, slots=True)
class _Ping:
    client_ns: int
    arrived_s: float


class Outbox:
    """A queue of answers: several tasks put, one sends in order. Threads encode the maps.

    ``on_encoded`` is called with the key of a map's stream, and with the processor's time for the
    map in seconds.
    """

    def __init__(
        self,
        write: Callable[[pb.StreamDepthResponse], Awaitable[None]],
        *,
        clock: Callable[[], float],
        metrics: Metrics,
        threads: ThreadPool,
        on_encoded: Callable[[str, float], None],
        on_sent: Callable[[SteppedFrame], None],
    ) -> None:
        self._write = write
        self._on_sent = on_sent
        self._threads = threads
        self._on_encoded = on_encoded
        self._clock = clock
        self._metrics = metrics
        self._answers: asyncio.Queue[pb.StreamDepthResponse | _Map | _Ping | None]
        self._answers = asyncio.Queue(_ROOM)
        self._unsent = asyncio.Semaphore(_UNSENT_MAPS)

    async def put(self, answer: pb.StreamDepthResponse) -> None:
        """Add an answer as it is."""
        await self._answers.put(answer)

    @property
    def full(self) -> bool:
        """True while there is no room for another answer."""
        return self._answers.full()

    def put_now(self, answer: pb.StreamDepthResponse) -> None:
        """Add an answer; there must be room."""
        self._answers.put_nowait(answer)

    def put_notice(self, notice: Notice) -> None:
        """Add a notice if there is room. A client that does not read would not read it either."""
        message = pb.Notice(kind=_NOTICE[notice.kind], message=notice.message, in_s=notice.in_s)
        if not self._answers.full():
            self._answers.put_nowait(pb.StreamDepthResponse(notice=message))

    async def put_pong(self, ping: pb.Ping, *, arrived_s: float) -> None:
        """Add the answer to a ping, which states how long the server held it."""
        await self._answers.put(_Ping(ping.client_ns, arrived_s))

    async def reserve_map(self) -> None:
        """Wait for room for one map. Call this before choosing the frame that needs it."""
        await self._unsent.acquire()

    def release_map(self) -> None:
        """Return the room that was reserved, because the frame failed."""
        self._unsent.release()

    async def put_map(self, stepped: SteppedFrame, *, map_step: int = 0) -> None:
        """Add a map, in the room that was reserved. ``map_step`` 0: as the stream was opened."""
        await self._answers.put(_Map(stepped, map_step))

    async def finish(self) -> None:
        """Accept no more answers."""
        await self._answers.put(None)

    async def send(self) -> None:
        """Write answers as they come, until the outbox is finished and empty."""
        while (answer := await self._answers.get()) is not None:
            match answer:
                case _Map(stepped, map_step):
                    cost = Cost()
                    response = await self._threads.run(cost.of, self._encoded, stepped, map_step)
                    self._on_encoded(stepped.stream.key, cost.seconds)
                    await self._write(response)
                    self._unsent.release()
                    self._on_sent(stepped)
                case _Ping(client_ns, arrived_s):
                    hold_ns = int((self._clock() - arrived_s) * 1e9)
                    pong = pb.Pong(
                        client_ns=client_ns,
                        server_hold_ns=hold_ns,
                        received_ns=int(arrived_s * 1e9),
                    )
                    await self._write(pb.StreamDepthResponse(pong=pong))
                case _:
                    await self._write(answer)

    def _encoded(self, stepped: SteppedFrame, map_step: int) -> pb.StreamDepthResponse:
        try:
            return self._encoded_map(stepped, map_step)
        except MemoryError:
            error = codec.error_to_frame_error(stepped.frame_id, out_of_memory())
            return pb.StreamDepthResponse(frame_error=error)

    def _encoded_map(self, stepped: SteppedFrame, map_step: int) -> pb.StreamDepthResponse:
        started_s = self._clock()
        response = pb.StreamDepthResponse()
        output = stepped.stream.config.output
        if map_step:
            output = replace(output, map_step=map_step)
        message = codec.disparity_to_proto(stepped.disparity_map(), output, into=response.disparity)
        message.received_ns = int(stepped.arrived_s * 1e9)
        message.saved_frame_id = stepped.stream.saver.saved_frame_id if stepped.stream.saver else 0
        now_s = self._clock()
        timings = replace(
            stepped.timings, encode_s=now_s - started_s, total_s=now_s - stepped.arrived_s
        )
        message.timings.CopyFrom(codec.timings_to_proto(timings))
        self._metrics.stage_s.labels("encode").observe(timings.encode_s)
        self._metrics.stage_s.labels("total").observe(timings.total_s)
        self._metrics.frame_age_s.observe(timings.total_s)
        return response
