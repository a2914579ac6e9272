"""What comes back from the server, and whom it is for."""

import asyncio
import time
from collections import deque

from vergence.connection import RESET
from vergence.in_flight import Flights
from vergence.results import DepthResult
from vergence.transports.base import ConnectionLost
from vergence_proto import codec
from vergence_proto.errors import DepthError, FrameStale
from vergence_proto.geometry import RectifiedRig
from vergence_proto.v1 import depth_pb2 as pb


class Answers:
    """The ear of a session at its :class:`~vergence.connection.Link`: one of its ``LinkUser``s."""

    opened: pb.StreamOpened
    rig: RectifiedRig

    def __init__(self) -> None:
        self.flights = Flights()
        self.error: Exception | None = None
        self.reset_after: int | None = None  # the last frame before a reset not yet confirmed
        self._ended = False
        self._unread: deque[DepthResult | DepthError] = deque()
        self._arrived = asyncio.Event()

    async def next(self) -> DepthResult:
        while not self._unread:
            if self._ended:
                raise self.error or StopAsyncIteration
            self._arrived.clear()
            await self._arrived.wait()
        item = self._unread.popleft()
        if isinstance(item, DepthError):
            raise item
        return item

    def attached(self, opened: pb.StreamOpened) -> list[bytes]:
        self.opened = opened
        self.rig = codec.rectified_rig_from_proto(opened.rig)
        self.flights.credit = max(opened.credit, 1)
        taken = ConnectionLost("the connection broke after the server took the frame")
        flights = self.flights.in_order()
        self.flights.abandon((f for f in flights if f.frame_id <= opened.last_frame_id), taken)
        flights = self.flights.in_order()
        requests = [flight.request for flight in flights]
        if self.reset_after is not None:
            before = sum(flight.frame_id <= self.reset_after for flight in flights)
            requests.insert(before, RESET)
        return requests

    def detached(self, lost: ConnectionLost) -> None:
        # A live frame is old by the time the connection is back; what is awaited is sent again.
        self.flights.abandon((f for f in self.flights.in_order() if f.answer is None), lost)

    def ended(self, error: Exception | None) -> None:
        self._ended = True
        self.error = error
        unanswered = error or ConnectionLost("the stream ended before the frame was answered")
        self.flights.abandon(self.flights.in_order(), unanswered)
        self._arrived.set()

    def answered(self, response: pb.StreamDepthResponse) -> None:
        match response.WhichOneof("message"):
            case "disparity":
                self._map(response.disparity)
            case "frame_error":
                message = response.frame_error
                self._failed(message.frame_id, codec.error_from_frame_error(message))
            case "frames_dropped":
                for frame_id in response.frames_dropped.frame_ids:
                    self._dropped(frame_id)

    def _map(self, message: pb.DisparityMap) -> None:
        age_s = (time.monotonic_ns() - message.capture_ns) * 1e-9
        if self.reset_after is not None and message.frame_id > self.reset_after:
            self.reset_after = None
        try:
            disparity_map = codec.disparity_from_proto(message, self.rig)
        except DepthError as error:  # a damaged answer is the trouble of its frame alone
            self._failed(message.frame_id, error)
            return
        flight = self.flights.land(message.frame_id)
        result = DepthResult.of(disparity_map, age_s=age_s, drops=self.flights.drops)
        if flight is None:
            return
        if flight.answer is None:
            self._deliver(result)
        elif not flight.answer.done():  # it is done if the caller gave up
            flight.answer.set_result(result)

    def _failed(self, frame_id: int, error: DepthError) -> None:
        flight = self.flights.land(frame_id)
        if flight is None:
            return
        if flight.answer is not None:
            flight.fail(error)
        elif isinstance(error, FrameStale):
            self.flights.count(stale=1)
        else:
            self._deliver(error)

    def _dropped(self, frame_id: int) -> None:
        flight = self.flights.land(frame_id)
        if flight is None:
            return
        if flight.answer is None:
            self.flights.count(displaced=1)
        flight.fail(FrameStale(f"frame {frame_id} was displaced by a newer one"))

    def _deliver(self, item: DepthResult | DepthError) -> None:
        """Keep for the reader what arrived, at most as many results as the credit: the newest."""
        self._unread.append(item)
        results = [each for each in self._unread if isinstance(each, DepthResult)]
        if len(results) > self.flights.credit:
            self._unread.remove(results[0])
            self.flights.count(unread=1)
        self._arrived.set()
