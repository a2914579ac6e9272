"""Routing of a stream's responses to the calls and readers that wait for them."""

import asyncio
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import fields
from functools import partial
from typing import TypeVar

from vergence.capture_clock import CaptureClock
from vergence.connection import RESET, FrameRequest, Request
from vergence.in_flight import FrameInFlight, FramesInFlight
from vergence.recent import RecentResults
from vergence.recording import SessionRecording
from vergence.results import DepthResult, Drops
from vergence.transports.base import ConnectionLost
from vergence_proto import codec
from vergence_proto.errors import DepthError, FrameStale
from vergence_proto.geometry import Axes, RectifiedRig
from vergence_proto.types import DisparityMap, ReceivedPlanes
from vergence_proto.v1 import depth_pb2 as pb

Value = TypeVar("Value")


class ResponseRouter:
    """The :class:`~vergence.connection.StreamListener` of a session.

    It resolves the frames in flight, and keeps the results of live frames for the reader.
    """

    rig: RectifiedRig

    def __init__(
        self,
        in_flight: FramesInFlight,
        axes: Axes,
        threads: Executor,
        clock: CaptureClock,
        *,
        paces: bool = False,
        lossless: bool = False,
    ) -> None:
        self._lossless = lossless
        self._clock = clock
        self._paces = paces  # the session paces its frames, so its credit is larger
        self.recent: RecentResults = RecentResults(clock.now_ns)
        self.opened: pb.StreamOpened | None = None  # None: the stream was never open
        self.error: Exception | None = None  # the error that ended the stream
        self.reset_after: int | None = None  # the last frame before a reset not yet confirmed
        self.recording: SessionRecording | None = None
        self._in_flight = in_flight
        self._axes = axes
        self._threads = threads
        self._ended = False
        self._unread: deque[DepthResult | DepthError] = deque()
        self._arrived = asyncio.Event()

    @property
    def awaited(self) -> bool:
        """True while a call waits for the answer to its frame."""
        return any(frame.answer is not None for frame in self._in_flight.in_order())

    async def next(self) -> DepthResult:
        """Wait for the next live result; raises its error, or the one that ended the stream."""
        while not self._unread:
            if self._ended:
                raise self.error or StopAsyncIteration
            self._arrived.clear()
            await self._arrived.wait()
        item = self._unread.popleft()
        if isinstance(item, DepthError):
            raise item
        return item

    def request_of(self, frame: FrameInFlight) -> Request:
        """Return the frame's request; if its images must be encoded, a thread does it later."""
        encode = frame.request

        async def encoded() -> bytes | None:
            if not self._in_flight.is_wanted(frame.frame_id):  # it was given up meanwhile
                return None
            try:
                request = encode if isinstance(encode, bytes) else await self._in_thread(encode)
            except DepthError as error:
                self._failed(frame.frame_id, error)
                return None
            if self.recording is not None:
                self.recording.sent(frame.frame_id, request)
            return request

        return FrameRequest(frame.frame_id, encoded)

    def attached(self, opened: pb.StreamOpened) -> list[Request]:
        """Record the open stream; return the requests that must be sent again."""
        self.opened = opened
        self.rig = codec.rectified_rig_from_proto(opened.rig)
        paced = self._paces and opened.paced_credit
        self._in_flight.credit = max(paced or opened.credit, 1)
        taken = ConnectionLost("the connection broke after the server took the frame")
        # A new stream needs no frame again whose answer is there.
        kept_from = opened.last_frame_id if opened.resumed and opened.snapshots else None
        self._in_flight.forget_kept(up_to=kept_from)
        frames = self._in_flight.in_order()
        self._in_flight.fail((f for f in frames if f.frame_id <= opened.last_frame_id), taken)
        requests: list[Request] = []
        reset_after = self.reset_after
        for frame in self._in_flight.to_send_again():
            reset_is_next = reset_after is not None and frame.frame_id > reset_after
            if frame.reset_before or reset_is_next:
                requests.append(RESET)
            if reset_is_next:
                reset_after = None
            requests.append(self.request_of(frame))
        if reset_after is not None:
            requests.append(RESET)
        return requests

    def detached(self, lost: ConnectionLost) -> None:
        """Discard the live frames: they will be old by the time the connection is back."""
        self._in_flight.fail((f for f in self._in_flight.in_order() if f.answer is None), lost)

    def ended(self, error: Exception | None) -> None:
        """Fail what is still in flight, and end the iteration."""
        self._ended = True
        self.error = error
        unanswered = error or ConnectionLost("the stream ended before the frame was answered")
        self._in_flight.fail(self._in_flight.in_order(), unanswered)
        self._arrived.set()

    async def answered(self, response: pb.StreamDepthResponse) -> None:
        """Route one response to its frame; a thread decodes the maps."""
        match response.WhichOneof("message"):
            case "disparity":
                await self._map(response.disparity)
            case "frame_error":
                message = response.frame_error
                self._failed(message.frame_id, codec.error_from_frame_error(message))
            case "frames_dropped":
                for frame_id in response.frames_dropped.frame_ids:
                    self._dropped(frame_id)

    async def _map(self, message: pb.DisparityMap) -> None:
        age_s = self._clock.age_s(message.capture_ns)
        if self.reset_after is not None and message.frame_id > self.reset_after:
            self.reset_after = None
        work = partial(_decoded, message, self.rig)
        plain = message.disparity.compression == pb.COMPRESSION_NONE and message.map_step <= 1
        try:
            disparity_map, raw = work() if plain else await self._in_thread(work)
        except DepthError as error:  # a damaged answer fails its own frame only
            self._failed(message.frame_id, error)
            return
        frame = self._in_flight.pop(message.frame_id)
        self._keep_until_saved(frame, message)
        result = _depth_result(
            disparity_map, raw, age_s=age_s, drops=self._in_flight.drops, axes=self._axes
        )
        if frame is None:
            return
        if self.recording is not None:
            self.recording.answered(message, result)
        self.recent.add(result)
        if frame.answer is None:
            self._deliver(result)
        elif not frame.answer.done():  # done: the caller was cancelled
            frame.answer.set_result(result)

    def _keep_until_saved(self, frame: FrameInFlight | None, message: pb.DisparityMap) -> None:
        """Keep an answered frame of a lossless session until its server has stored the state."""
        self._in_flight.forget_kept(up_to=message.saved_frame_id)
        stores = self._lossless and self.opened is not None and self.opened.snapshots
        if frame is not None and stores and frame.frame_id > message.saved_frame_id:
            self._in_flight.keep(frame)

    async def _in_thread(self, work: Callable[[], Value]) -> Value:
        return await asyncio.get_running_loop().run_in_executor(self._threads, work)

    def _failed(self, frame_id: int, error: DepthError) -> None:
        if self.recording is not None:
            self.recording.unanswered(frame_id)
        frame = self._in_flight.pop(frame_id)
        if frame is None:
            return
        if frame.answer is not None:
            frame.fail(error)
        elif isinstance(error, FrameStale):
            self._in_flight.count(stale=1)
        else:
            self._deliver(error)

    def _dropped(self, frame_id: int) -> None:
        if self.recording is not None:
            self.recording.unanswered(frame_id)
        frame = self._in_flight.pop(frame_id)
        if frame is None:
            return
        if frame.answer is None:
            self._in_flight.count(displaced=1)
        frame.fail(FrameStale(f"frame {frame_id} was displaced by a newer one"))

    def _deliver(self, item: DepthResult | DepthError) -> None:
        """Keep an item for the reader; of the results keep the newest, as many as the credit."""
        self._unread.append(item)
        results = [each for each in self._unread if isinstance(each, DepthResult)]
        if len(results) > self._in_flight.credit:
            self._unread.remove(results[0])
            self._in_flight.count(unread=1)
        self._arrived.set()


def _decoded(message: pb.DisparityMap, rig: RectifiedRig) -> tuple[DisparityMap, ReceivedPlanes]:
    received = codec.received_planes_from_proto(message, rig)
    return codec.disparity_from_proto(message, rig, received), received


def _depth_result(
    disparity_map: DisparityMap, raw: ReceivedPlanes, *, age_s: float, drops: Drops, axes: Axes
) -> DepthResult:
    values = {each.name: getattr(disparity_map, each.name) for each in fields(DisparityMap)}
    return DepthResult(**values, raw=raw, age_s=age_s, drops=drops, axes=axes)
