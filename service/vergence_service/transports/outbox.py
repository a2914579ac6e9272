"""Answers on their way to one client."""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from vergence_proto import codec
from vergence_proto.v1 import depth_pb2 as pb
from vergence_service.metrics import Metrics
from vergence_service.streams.conversion import SteppedFrame
from vergence_service.streams.stream import Notice, NoticeKind

# One map is encoded and sent while the next is stepped. Past it the stepper waits for the client
# to read, and newer frames displace older ones in the mailbox.
_UNSENT_MAPS = 2
# Short answers to a client that does not read; past it its frames are not read either.
_ROOM = 64

_NOTICE = {
    NoticeKind.DRAINING: pb.NOTICE_KIND_DRAINING,
    NoticeKind.EXPIRING: pb.NOTICE_KIND_EXPIRING,
}


@dataclass(frozen=True, slots=True, eq=False)
class _Map:
    answer: SteppedFrame
    arrived_s: float


@dataclass(frozen=True, slots=True)
class _Ping:
    client_ns: int
    arrived_s: float


class Outbox:
    """Several tasks put, one sends, in order. Maps are encoded in a worker thread."""

    def __init__(
        self,
        write: Callable[[pb.StreamDepthResponse], Awaitable[None]],
        *,
        clock: Callable[[], float],
        metrics: Metrics,
    ) -> None:
        self._write = write
        self._clock = clock
        self._metrics = metrics
        self._answers: asyncio.Queue[pb.StreamDepthResponse | _Map | _Ping | None]
        self._answers = asyncio.Queue(_ROOM)
        self._unsent = asyncio.Semaphore(_UNSENT_MAPS)

    async def put(self, answer: pb.StreamDepthResponse) -> None:
        await self._answers.put(answer)

    def put_notice(self, notice: Notice) -> None:
        """Never waits: a client that does not read would not read this either."""
        message = pb.Notice(kind=_NOTICE[notice.kind], message=notice.message, in_s=notice.in_s)
        if not self._answers.full():
            self._answers.put_nowait(pb.StreamDepthResponse(notice=message))

    async def put_pong(self, ping: pb.Ping, *, arrived_s: float) -> None:
        await self._answers.put(_Ping(ping.client_ns, arrived_s))

    async def reserve_map(self) -> None:
        """Wait for room, before the frame is chosen that takes it."""
        await self._unsent.acquire()

    def release_map(self) -> None:
        """No map came of the frame."""
        self._unsent.release()

    async def put_map(self, answer: SteppedFrame, *, arrived_s: float) -> None:
        """Into the room that was reserved; ``arrived_s`` is its frame's."""
        await self._answers.put(_Map(answer, arrived_s))

    async def finish(self) -> None:
        """Nothing follows."""
        await self._answers.put(None)

    async def send(self) -> None:
        """Write answers as they come, until the outbox is finished and empty."""
        while (answer := await self._answers.get()) is not None:
            match answer:
                case _Map():
                    await self._write(await asyncio.to_thread(self._encoded, answer))
                    self._unsent.release()
                case _Ping(client_ns, arrived_s):
                    hold_ns = int((self._clock() - arrived_s) * 1e9)
                    pong = pb.Pong(client_ns=client_ns, server_hold_ns=hold_ns)
                    await self._write(pb.StreamDepthResponse(pong=pong))
                case _:
                    await self._write(answer)

    def _encoded(self, waiting: _Map) -> pb.StreamDepthResponse:
        started_s = self._clock()
        answer, response = waiting.answer, pb.StreamDepthResponse()
        message = codec.disparity_to_proto(
            answer.disparity_map(), answer.stream.config.output, into=response.disparity
        )
        encode_s = self._clock() - started_s
        total_s = self._clock() - waiting.arrived_s
        message.timings.encode_us = round(encode_s * 1e6)
        message.timings.total_us = round(total_s * 1e6)
        self._metrics.stage_s.labels("encode").observe(encode_s)
        self._metrics.stage_s.labels("total").observe(total_s)
        return response
