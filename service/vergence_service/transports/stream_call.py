"""One StreamDepth call, on any transport: a reader, a stepper and a sender that overlap."""

import asyncio
import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from functools import partial

from vergence_proto import codec
from vergence_proto.errors import (
    DepthError,
    Draining,
    StreamExists,
    StreamExpired,
    UnknownStream,
)
from vergence_proto.types import Delivery
from vergence_proto.v1 import depth_pb2 as pb
from vergence_service.access.principals import Principal
from vergence_service.process.logs import log_event
from vergence_service.process.threads import Cost
from vergence_service.streams.conversion import SteppedFrame
from vergence_service.streams.engine import DepthEngine
from vergence_service.streams.stream import Notice, Stream
from vergence_service.transports.callers import TRACE_PARENT
from vergence_service.transports.displaced import DisplacedFrames
from vergence_service.transports.mailbox import Mailbox, QueuedFrame
from vergence_service.transports.opening import stream_config
from vergence_service.transports.outbox import Outbox
from vergence_service.transports.unary import model_info

log = logging.getLogger(__name__)

# ``write_s`` is the time for answers up to this size. Larger ones have more time, in proportion.
_USUAL_BYTES = 1 << 20
_SLOWEST_READER_BYTES_S = 64 << 10
# What it costs to receive an image: a stream is charged for it, also for frames that it floods.
_RECEIVING_S_PER_BYTE = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamLimits:
    """The limits of one call."""

    credit: int  # most frames that a client may send before an answer returns
    paced_credit: int  # the same for a live client that paces them by the link
    waiting_frames: int  # frames of a lossless stream that wait before the sender must wait
    max_frame_bytes: int
    silent_s: float  # a client that pinged and sends nothing for this long counts as lost
    write_s: float  # so does a client that does not read an answer for this long
    iterations: int  # most that a principal with a credential may ask for


class ClientLost(Exception):
    """The client is silent or does not read. It may not see how its call ends, and may resume."""

    def __init__(self, why: str, *, reads: bool) -> None:
        super().__init__(why)
        self.reads = reads


class DepthCall:
    """One connection to one stream: the stream's attachment."""

    def __init__(
        self,
        engine: DepthEngine,
        requests: AsyncIterator[codec.Request],
        write: Callable[[pb.StreamDepthResponse], Awaitable[None]],
        *,
        client: str,
        caller: Principal,
        transport: str,
        limits: StreamLimits,
        clock: Callable[[], float],
    ) -> None:
        self._engine = engine
        self._requests = requests
        self._write = write
        self._client = client
        self._caller = caller
        self.transport = transport
        self.trace_parent = TRACE_PARENT.get()
        self._limits = limits
        self._clock = clock
        self._outbox = Outbox(
            self._write_in_time,
            clock=clock,
            metrics=engine.metrics,
            threads=engine.threads.live,
            on_encoded=engine.turns.charge,
            on_sent=engine.resumer.save_after,  # not before the client has its answer
        )
        self._displaced = DisplacedFrames(self._outbox, on_reported=self._answered)
        self._reader: asyncio.Task[None] | None = None
        self._stepper: asyncio.Task[None] | None = None
        self._stream: Stream | None = None
        self._error: DepthError | None = None  # the error that the call ends with
        self._client_is_done = False
        self._pings = False  # the client has pinged, so its silence says that it is lost
        self._owed = 0  # frames that have no answer yet
        self._heard_s = clock()  # time of the last message, or of the answer that it waited for
        self._paces = False
        self._overran = False  # the client has sent more frames than its credit allows
        self._lost: asyncio.Future[ClientLost] = asyncio.get_running_loop().create_future()
        self._detached = asyncio.Event()

    @property
    def busy(self) -> bool:
        return self._owed > 0

    @property
    def silent_s(self) -> float:
        return self._clock() - self._heard_s if self._pings and not self.busy else 0.0

    def lose(self, why: str) -> None:
        self._lose(ClientLost(why, reads=True))

    def _lose(self, lost: ClientLost) -> None:
        if not self._lost.done():
            self._lost.set_result(lost)

    async def ended(self) -> None:
        await self._detached.wait()

    def notify(self, notice: Notice) -> None:
        self._outbox.put_notice(notice)

    async def report_lost(self, frame_ids: Sequence[int]) -> None:
        """Count and answer frames that the client sent and the transport lost."""
        if self._stream is not None and frame_ids:
            await self._drop(self._stream, frame_ids)

    def end(self, error: DepthError) -> None:
        """Stop reading and stepping at once, send what is ready, and end with the error."""
        if isinstance(error, StreamExpired) and self._overran:
            # A client that keeps to its credit reads its answers. This one may not, and an error
            # would wait behind them.
            self._lose(ClientLost(str(error), reads=False))
        self.finish(error)
        if self._stepper is not None:
            self._stepper.cancel()

    def finish(self, error: DepthError) -> None:
        """Stop reading, answer the frames that have arrived, and end with the error."""
        self._error = self._error or error
        if self._reader is not None:
            self._reader.cancel()

    async def run(self) -> None:
        """Serve the call to its end. Raises the DepthError that it ends with, or ClientLost."""
        try:
            stream, resumed = await self._open()
        except DepthError as error:
            self._engine.metrics.openings.labels(error.code).inc()
            log_event(
                log,
                "stream refused",
                principal=self._caller.name,
                transport=self.transport,
                address=self._client,
                reason=error.code,
            )
            raise
        self._stream = stream
        try:
            await self._write_in_time(pb.StreamDepthResponse(opened=self._opened(stream, resumed)))
            if self._error is None:
                await self._serve(stream)
        finally:
            self._engine.streams.detach(stream, self)
            self._engine.resumer.left(stream)
            self._detached.set()
        if self._error is not None:
            if isinstance(self._error, Draining):  # another server has the stream next
                await self._engine.resumer.flush(stream)
            raise self._error
        if self._client_is_done:
            await self._engine.close(stream.stream_id, owner=stream.owner.name)

    async def _serve(self, stream: Stream) -> None:
        mailbox = Mailbox(stream.config.delivery, capacity=self._limits.waiting_frames)
        lost: ClientLost | None = None
        try:
            async with asyncio.TaskGroup() as tasks:
                watching = tasks.create_task(self._raise_if_lost())
                sending = tasks.create_task(self._outbox.send())
                self._reader = tasks.create_task(self._read(stream, mailbox))
                self._stepper = tasks.create_task(self._step(stream, mailbox))
                await asyncio.wait([self._reader, self._stepper])
                await self._outbox.finish()
                await sending
                watching.cancel()
        except* ClientLost as group:
            [first, *_] = group.exceptions
            assert isinstance(first, ClientLost)  # a task of the group raised it
            lost = first
        finally:
            mailbox.discard()
        if lost is not None:
            raise lost

    async def _raise_if_lost(self) -> None:
        raise await self._lost

    async def _write_in_time(self, response: pb.StreamDepthResponse) -> None:
        more_bytes = max(response.ByteSize() - _USUAL_BYTES, 0)
        patience_s = self._limits.write_s + more_bytes / _SLOWEST_READER_BYTES_S
        try:
            async with asyncio.timeout(patience_s):
                await self._write(response)
        except TimeoutError:
            raise ClientLost(
                f"the client did not read an answer for {patience_s:.0f} s", reads=False
            ) from None

    async def _open(self) -> tuple[Stream, bool]:
        request = await anext(aiter(self._requests), None)
        if isinstance(request, pb.OpenStream):
            self._paces = request.paces and request.delivery != pb.DELIVERY_EVERY
        else:
            raise UnknownStream("the first message of a call must open or resume a stream")
        config = stream_config(request, self._caller, most_iterations=self._limits.iterations)
        if request.resume_token:
            resumed = await self._engine.resume(
                request.stream_id,
                request.resume_token,
                config,
                attachment=self,
                client=self._client,
                owner=self._caller,
            )
            return resumed, True
        opened = await self._engine.open(
            request.stream_id,
            config,
            attachment=self,
            client=self._client,
            owner=self._caller,
        )
        return opened, False

    def _opened(self, stream: Stream, resumed: bool) -> pb.StreamOpened:
        return pb.StreamOpened(
            stream_id=stream.stream_id,
            resume_token=stream.resume_token,
            credit=self._limits.credit,
            rig=codec.rectified_rig_to_proto(stream.rectifier.rig),
            model=model_info(self._engine.card),
            resumed=resumed,
            detach_grace_s=self._engine.streams.detach_grace_s,
            idle_timeout_s=self._engine.streams.idle_timeout_s,
            last_frame_id=stream.last_frame_id,
            snapshots=stream.saver is not None,
            silent_s=self._limits.silent_s,
            max_frame_scale=codec.MAX_FRAME_SCALE,
            paced_credit=self._limits.paced_credit if self._paces else 0,
            left_from_rectified=(
                None
                if stream.rectifier.maps is None
                else codec.pose_to_proto(stream.rectifier.left_from_rectified)
            ),
        )

    @property
    def _most_unanswered(self) -> int:
        return self._limits.paced_credit if self._paces else self._limits.credit

    async def _read(self, stream: Stream, mailbox: Mailbox) -> None:
        try:
            async for request in self._requests:
                arrived_s = self._heard_s = self._clock()
                match request:
                    case codec.ReceivedFrame():
                        await self._receive(stream, mailbox, request, arrived_s)
                    case pb.Ping():
                        self._pings = True
                        await self._outbox.put_pong(request, arrived_s=arrived_s)
                    case pb.Reset():
                        mailbox.reset()
                    case pb.End():
                        self._client_is_done = True
                        return
                    case pb.OpenStream():
                        self.end(StreamExists("this call has already opened its stream"))
        except DepthError as error:  # the bytes are not a message
            self.end(error)
        finally:
            await mailbox.finish()

    async def _receive(
        self, stream: Stream, mailbox: Mailbox, frame: codec.ReceivedFrame, arrived_s: float
    ) -> None:
        self._owed += 1
        self._overran = self._overran or self._owed > self._most_unanswered
        receiving_s = frame.nbytes * _RECEIVING_S_PER_BYTE
        self._engine.turns.charge(stream.key, receiving_s)
        rig = stream.rectifier.rig
        try:
            codec.check_frame(
                frame, size=(rig.width, rig.height), max_bytes=self._limits.max_frame_bytes
            )
            displaced = await self._keep(stream, mailbox, frame, arrived_s)
        except DepthError as error:
            self._engine.count_failed(stream, error)
            await self._refuse(frame.frame_id, error)
            return
        if displaced is not None:
            displaced.memory.release()
            self._engine.count_dropped(stream)
            await self._displaced.add(displaced.frame_id)

    async def _keep(
        self, stream: Stream, mailbox: Mailbox, frame: codec.ReceivedFrame, arrived_s: float
    ) -> QueuedFrame | None:
        """Put a frame into the mailbox; return the frame that it displaced, if any."""
        budget = self._engine.memory
        live = stream.config.delivery is Delivery.NEWEST
        memory = (
            budget.hold_frame(frame.nbytes) if live else await budget.wait_for_frame(frame.nbytes)
        )
        try:
            return await mailbox.put(QueuedFrame(frame, arrived_s, memory))
        except BaseException:
            memory.release()
            raise

    async def _drop(self, stream: Stream, frame_ids: Sequence[int]) -> None:
        for _ in frame_ids:
            self._engine.count_dropped(stream)
        dropped = pb.FramesDropped(frame_ids=frame_ids)
        await self._outbox.put(pb.StreamDepthResponse(frames_dropped=dropped))

    async def _step(self, stream: Stream, mailbox: Mailbox) -> None:
        while True:
            await self._outbox.reserve_map()
            waited = mailbox.holds_frame
            if not await mailbox.filled():
                await self._displaced.report()
                return
            async with self._turn(stream, wants_more=waited) as cost:
                queued = await mailbox.take()
                if queued is None:
                    return
                stepped = await self._stepped(stream, queued, cost)
            # Not in the turn: the client may be slow to read.
            if stepped is not None:
                await self._outbox.put_map(stepped, map_step=queued.frame.fields.map_step)
                self._answered()

    @asynccontextmanager
    async def _turn(self, stream: Stream, *, wants_more: bool) -> AsyncIterator[Cost]:
        """Wait for a turn of a live stream. The steps of others run in the gaps."""
        if stream.config.delivery is not Delivery.NEWEST:
            yield Cost()
            return
        self._displaced.wait()
        async with self._engine.turns.turn(
            stream.key, stream.owner, on_soon=self._displaced.report_now, wants_more=wants_more
        ) as turn:
            self._displaced.begin()
            yield turn.cost

    async def _stepped(
        self, stream: Stream, queued: QueuedFrame, cost: Cost
    ) -> SteppedFrame | None:
        """Step a frame; None if it failed and was answered with the error."""
        size = stream.rectifier.rig.width, stream.rectifier.rig.height
        fields = queued.frame.fields
        try:
            if queued.reset_before:
                await self._engine.reset(stream.stream_id, owner=stream.owner.name)
            return await self._engine.step(
                stream.stream_id,
                partial(codec.decode_frame, queued.frame, size=size),
                arrived_s=queued.arrived_s,
                cost=cost,
                owner=stream.owner.name,
                max_age_s=fields.max_age_s if fields.HasField("max_age_s") else None,
            )
        except DepthError as error:
            self._outbox.release_map()
            await self._refuse(queued.frame_id, error)
            return None
        finally:
            queued.memory.release()

    async def _refuse(self, frame_id: int, error: DepthError) -> None:
        message = codec.error_to_frame_error(frame_id, error)
        await self._outbox.put(pb.StreamDepthResponse(frame_error=message))
        self._answered()

    def _answered(self) -> None:
        """Count the answer of a frame. The client's time to say something starts again."""
        self._owed -= 1
        self._heard_s = self._clock()
