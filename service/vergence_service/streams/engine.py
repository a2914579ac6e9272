"""The engine: open a stream, step it frame by frame, close it."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager, suppress
from enum import Enum
from functools import partial

from vergence_proto.errors import (
    DepthError,
    Draining,
    NonFinite,
    NotReady,
    UnknownStream,
)
from vergence_proto.types import (
    Delivery,
    DisparityMap,
    Origin,
    StereoFrame,
    StereoRig,
    Timings,
)
from vergence_service.access.principals import LOCAL, Principal
from vergence_service.inference.batcher import StepBatcher
from vergence_service.inference.model import RecurrentState, Step, StereoModel, StereoView
from vergence_service.process.failures import out_of_memory
from vergence_service.process.memory import MemoryBudget, StreamMemory
from vergence_service.process.metrics import Metrics
from vergence_service.process.threads import Cost, Threads
from vergence_service.snapshots.saver import Snapshots
from vergence_service.streams.continuity import ContinuityLimits
from vergence_service.streams.conversion import SteppedFrame, decoded_view
from vergence_service.streams.iterations import IterationCounts, check_weights
from vergence_service.streams.needs import ImageSizes, stream_memory
from vergence_service.streams.rectify import Rectifier, check_rig
from vergence_service.streams.resuming import StreamResumer
from vergence_service.streams.search_window import SearchReach
from vergence_service.streams.stream import Attachment, Notice, NoticeKind, Stream, StreamConfig
from vergence_service.streams.table import StreamTable
from vergence_service.streams.traces import FrameTraces
from vergence_service.streams.turns import Turns
from vergence_service.streams.viewers import Viewers

# A client that comes while the model loads waits for at most this long. It is below the time that
# the SDK waits for a stream to open, 5 s.
_LOADING_PATIENCE_S = 3.0
# A client that does not read keeps its connection for longer than this.
_CLOSE_S = 1.0


class _Phase(Enum):
    LOADING = "loading"
    SERVING = "serving"
    DRAINING = "draining"


class DepthEngine:
    """Everything that a transport may ask for. It knows no wire format and raises only DepthError.

    Frames of one stream are stepped one at a time, in the order in which they arrive.
    """

    def __init__(
        self,
        streams: StreamTable,
        batcher: StepBatcher,
        *,
        model: StereoModel,
        memory: MemoryBudget,
        iterations: int,
        cold_iterations: Mapping[Delivery, int],
        limits: ContinuityLimits,
        sizes: ImageSizes,
        min_range_share: float,
        clock: Callable[[], float],
        metrics: Metrics,
        threads: Threads,
        turns: Turns | None = None,
        snapshots: Snapshots | None = None,
    ) -> None:
        self.streams = streams
        self.turns = Turns(places=2, lanes=1, clock=clock) if turns is None else turns
        self.card = model.card
        self.memory = memory
        self.max_pixels = sizes.max_pixels
        self.metrics = metrics
        self.threads = threads
        self.viewers = Viewers()
        self.traces: FrameTraces | None = None
        self._batcher = batcher
        self._model = model
        self._sizes = sizes
        self._iterations = IterationCounts(self.card, iterations, cold_iterations)
        self.continuity = limits  # beyond which a frame starts cold
        self._reach = SearchReach(self.card.max_disparity_px, min_range_share)
        self._clock = clock
        self._phase = _Phase.LOADING
        self._started = asyncio.Event()
        self.resumer = StreamResumer(
            streams,
            snapshots,
            weights_sha256=self.card.weights_sha256,
            memory_of=self._check_opening,
            rectifier_of=self._rectifier,
        )

    @property
    def ready(self) -> bool:
        """True while new streams are accepted."""
        return self._phase is _Phase.SERVING

    @property
    def health(self) -> str:
        """loading, serving or draining."""
        return self._phase.value

    @property
    def computed_by(self) -> str:
        """The inference engine and its instruction set."""
        return self._model.engine

    @property
    def lanes(self) -> int:
        """The number of steps that the model can take side by side."""
        return self._model.max_concurrent_steps

    @property
    def provider(self) -> str:
        """The execution provider of the model."""
        return self._model.provider

    async def start(self) -> None:
        """Load what live streams need, and accept streams.

        Until then, opening a stream waits, and raises NotReady after a few seconds.
        """
        await self._load(Delivery.NEWEST)
        self._phase = _Phase.SERVING
        self._started.set()

    async def load_rest(self) -> None:
        """Load what lossless streams and pairs need besides; they wait for it."""
        await self._load(Delivery.EVERY)

    async def _load(self, delivery: Delivery) -> None:
        await self._batcher.warm_up(*self._iterations.loaded_for(delivery))

    def drain(self, *, within_s: float) -> None:
        """Accept no new streams, and notify the clients that are attached."""
        self._phase = _Phase.DRAINING
        self._started.set()
        notice = Notice(NoticeKind.DRAINING, "the server is shutting down", within_s)
        for attachment in self.streams.attachments():
            attachment.notify(notice)

    async def open(
        self,
        stream_id: str,
        config: StreamConfig,
        *,
        attachment: Attachment | None = None,
        client: str = "",
        owner: Principal = LOCAL,
    ) -> Stream:
        """Open a stream of ``owner``. It counts towards its limits, and the one of ``client``.

        ``client`` is an address.

        Raises NotReady or Draining if no streams are accepted, ModelChanged, BadCalibration or
        FrameTooLarge if the configuration cannot be served, BadShape if the id is not allowed,
        StreamExists if it is in use, and Quota, StreamLimit or StateMemory if a limit is reached.
        """
        check_weights(config, self.card)
        made = self.streams.made_by(stream_id, config.opening_id, owner=owner.name)
        if made is not None and attachment is not None:  # the client did not get the answer
            return await self.resume(
                stream_id,
                made.resume_token,
                config,
                attachment=attachment,
                client=client,
                owner=owner,
            )
        need = await self._check_opening(config)
        with self.streams.reserve(stream_id, need, client=client, owner=owner) as place:
            rectifier = await self._rectifier(config.rig)
            stream = self.streams.open(place, config, rectifier, attachment=attachment)
        self.resumer.keep(stream)
        return stream

    async def resume(
        self,
        stream_id: str,
        resume_token: bytes,
        config: StreamConfig,
        *,
        attachment: Attachment,
        client: str = "",
        owner: Principal = LOCAL,
    ) -> Stream:
        """Attach a new connection to an open stream, here or of another server's snapshot.

        Raises NotReady or Draining if no streams are accepted, ModelChanged if the server runs
        other weights, UnknownStream or StreamExpired if the stream is gone, StreamExists if the
        token is wrong, and BadCalibration if the rig is another one.
        """
        self._check_serving()
        # Check the model before the stream. A server that restarted does not know the stream any
        # more, but the client must learn that a new stream would run on another network.
        check_weights(config, self.card)
        return await self.resumer.resume(
            stream_id, resume_token, config, attachment=attachment, client=client, owner=owner
        )

    async def step(
        self,
        stream_id: str,
        decode: Callable[[], StereoFrame],
        *,
        arrived_s: float,
        cost: Cost,
        max_age_s: float | None = None,
        owner: str = LOCAL.name,
    ) -> SteppedFrame:
        """Advance one stream by one frame. A step that fails leaves the stream unchanged.

        ``decode`` runs in a worker thread when it is the frame's turn, so a frame that is displaced
        before that is never decoded. The caller makes the disparity map from the stepped frame, in
        the thread that also encodes it. The time of decoding and of the step is added to ``cost``.

        Raises what ``decode`` raises; UnknownStream or StreamExpired if the stream is gone;
        BadShape, FrameOutOfOrder or FrameStale if the frame is refused; ModelFailed; Draining; and
        NonFinite, after which the stream starts again without a state.
        """
        stream = self.streams.get(stream_id, owner=owner)
        self.streams.touch(stream)
        decoded = partial(self.threads.live.run, cost.of, decoded_view, decode, stream)
        try:
            stepped = await self._step(
                stream, decoded, arrived_s=arrived_s, cost=cost, max_age_s=max_age_s
            )
        finally:
            self.streams.touch(stream)  # a step may take longer than the idle timeout
        if self.traces is not None:
            self.traces.add(stepped, age_s=self._clock() - arrived_s)
        return stepped

    async def check_offline(self, config: StreamConfig) -> None:
        """Refuse what :meth:`offline` would refuse, with the same errors."""
        self.memory.check_possible(await self._check_opening(config))
        await self.threads.background.run(check_rig, config.rig, self._reach)

    @asynccontextmanager
    async def offline(
        self, config: StreamConfig, *, state: RecurrentState | None = None, owner: str = LOCAL.name
    ) -> AsyncIterator[Stream]:
        """Open a stream without a client, for a sequence whose frames are all known.

        The stream lasts as long as the block, and is not in the table: it takes no place from live
        streams. It waits for its memory. It continues from ``state``, the state after earlier
        frames.

        Raises NotReady or Draining if no streams are accepted, BadCalibration if the rig cannot be
        rectified, and FrameTooLarge if its images are too large.
        """
        need = await self._check_opening(config)
        with await self.memory.wait_for_stream(need) as memory:
            rectifier = await self._rectifier(config.rig)
            if not self.card.recurrent:
                state = None
            origin = Origin.COLD_START if state is None else Origin.WARM
            now_s = self._clock()
            stream = Stream("", "", b"", config, rectifier, memory, None, now_s)
            stream.state, stream.origin, stream.owner = state, origin, Principal(owner)
            yield stream

    async def step_view(self, stream: Stream, frame_id: int, view: StereoView) -> SteppedFrame:
        """Advance a stream of :meth:`offline` by a frame whose view was made in a thread.

        Raises FrameOutOfOrder, ModelFailed, NonFinite and Draining.
        """

        async def decoded() -> tuple[int, StereoView]:
            return frame_id, view

        return await self._step(stream, decoded, arrived_s=self._clock(), cost=Cost())

    async def step_offline(self, stream: Stream, frame: StereoFrame) -> DisparityMap:
        """Advance a stream of :meth:`offline` by one frame, and return the map.

        Raises BadShape if the images do not fit, and what :meth:`step_view` raises.
        """
        pool = self.threads.background
        frame_id, view = await pool.run(decoded_view, lambda: frame, stream)
        stepped = await self.step_view(stream, frame_id, view)
        return await pool.run(stepped.disparity_map)

    async def reset(self, stream_id: str, *, owner: str = LOCAL.name) -> None:
        """Let later frames start without a state. Raises UnknownStream, StreamExpired."""
        stream = self.streams.get(stream_id, owner=owner)
        async with stream.turn:
            self._forget(stream, Origin.RESET_REQUESTED)

    def count_dropped(self, stream: Stream) -> None:
        """Count a frame that a newer frame displaced."""
        stream.frames_dropped += 1
        stream.frames_skipped += 1
        self.metrics.frames_dropped.inc()

    def count_failed(self, stream: Stream, error: DepthError) -> None:
        """Count a frame that was answered with an error."""
        stream.frames_failed += 1
        stream.frames_skipped += 1
        stream.failures[error.code] += 1
        self.metrics.frames_failed.labels(error.code).inc()

    async def close(self, stream_id: str, *, owner: str = LOCAL.name) -> None:
        """End a stream and free its state; any connection of its owner may ask for it.

        Returns when the stream's own connection has ended too, but after at most a second.

        Raises UnknownStream, StreamExpired.
        """
        stream = self.streams.get(stream_id, owner=owner)
        self.streams.close(stream)
        if stream.attachment is not None:
            stream.attachment.end(UnknownStream(f"stream {stream_id!r} was closed"))
            with suppress(TimeoutError):
                await asyncio.wait_for(stream.attachment.ended(), _CLOSE_S)

    def _check_serving(self) -> None:
        match self._phase:
            case _Phase.LOADING:
                raise NotReady("the model is loading; try again", retry_after_s=1.0)
            case _Phase.DRAINING:
                raise Draining("the server is shutting down; try another one")

    async def _check_opening(self, config: StreamConfig) -> StreamMemory:
        with suppress(TimeoutError):
            async with asyncio.timeout(_LOADING_PATIENCE_S):
                await self._started.wait()
        self._check_serving()
        self._sizes.check(config.rig)
        return stream_memory(
            config.rig,
            self._model,
            self._reach,
            warm_iterations=self._iterations.of(config, cold=False),
            cold_iterations=self._iterations.of(config, cold=True),
            snapshots=self.resumer.keeps_snapshots,
        )

    async def _rectifier(self, rig: StereoRig) -> Rectifier:
        try:
            return await self.threads.background.run(Rectifier.of, rig, self._reach)
        except MemoryError:
            raise out_of_memory() from None

    async def _step(
        self,
        stream: Stream,
        decoded: Callable[[], Awaitable[tuple[int, StereoView]]],
        *,
        arrived_s: float,
        cost: Cost,
        max_age_s: float | None = None,
    ) -> SteppedFrame:
        # The lock wakes its waiters in order. So a stream takes its frames one at a time as they
        # arrived, and no batch ever holds two frames of one stream.
        async with stream.turn:
            try:
                started_s = self._clock()
                skipped = stream.frames_skipped
                frame_id, view = await decoded()
                decode_s = self._clock() - started_s
                stream.check_order(frame_id)
                state, origin = stream.state_before(view, self.continuity)
                iterations = self._iterations.of(stream.config, cold=state is None)
                live = stream.config.delivery is Delivery.NEWEST
                result, timings = await self._batcher.step(
                    Step(view, state, iterations),
                    timings=Timings(decode_s=decode_s, queue_s=started_s - arrived_s),
                    deadline_s=None if max_age_s is None else arrived_s + max_age_s,
                    live_stream=stream.key if live else None,
                    owner=stream.owner.name,
                    cost=cost,
                )
            except DepthError as error:
                self.count_failed(stream, error)
                if isinstance(error, NonFinite):
                    self._forget(stream, Origin.RESET_NON_FINITE)
                raise
            stream.commit(frame_id, result.state, frames_skipped=skipped)
        stream.note_answer(self._clock(), arrived_s, origin, iterations, timings.model_s)
        self.metrics.model_s.labels(stream.owner.name).inc(timings.model_s)
        self.metrics.frames_stepped.labels(origin.name.lower()).inc()
        for stage in ("decode", "queue", "model"):
            self.metrics.stage_s.labels(stage).observe(getattr(timings, f"{stage}_s"))
        stepped = SteppedFrame(
            stream, frame_id, arrived_s, view, result, origin, iterations, skipped, timings
        )
        self.viewers.show(stepped)
        return stepped

    def _forget(self, stream: Stream, reason: Origin) -> None:
        """Discard the stream's state. A model without memory has none, so it has no reason."""
        stream.forget(reason if self.card.recurrent else Origin.COLD_START)
        self.resumer.save(stream)
