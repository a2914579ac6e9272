"""One stereo stream, from the client's side: frames in, depth out."""

import asyncio
import time
from collections.abc import Callable
from typing import Self

import numpy as np
from numpy.typing import NDArray

from vergence.connection import RESET, Link
from vergence.in_flight import Flight
from vergence.info import ModelInfo
from vergence.responses import Answers
from vergence.results import DepthResult, Drops, SessionEvent
from vergence.transports.base import Transport
from vergence_proto import codec
from vergence_proto.geometry import Matrix, Pose, RectifiedRig
from vergence_proto.types import Delivery, ImageEncoding, PoseSample, StereoFrame
from vergence_proto.v1 import depth_pb2 as pb

WorldFromLeft = Pose | PoseSample | Matrix | None


class DepthSession:
    """Made by :meth:`vergence.DepthClient.open_session`; open inside ``async with``.

    There are two ways to use it. Request and response, nothing is dropped::

        result = await session.step(left, right, world_from_left)

    Live, newest wins: one task submits frames as the cameras give them, another reads::

        session.submit(left, right, world_from_left)

        async for result in session:
            show(result.depth_m)

    Images are uint8, grey [H, W] or RGB [H, W, 3], of the rig's size, and are the caller's again
    when the method returns. A pose says where the left camera was at mid-exposure, camera to
    world, in the session's axes; a matrix is [3, 4] or [4, 4]. Without a pose nothing is warped.

    Methods are for the event loop's own thread; a camera that calls back from another one hands
    over by ``loop.call_soon_threadsafe(session.submit, left, right, world_from_left)``.

    A connection that breaks is made again and the stream resumed where it stood, for as long as
    the server keeps its state; ``on_event`` hears of it, and the next result's origin is RESUMED.
    """

    def __init__(
        self,
        transport: Transport,
        opening: pb.OpenStream,
        *,
        encoding: ImageEncoding,
        jpeg_quality: int,
        on_event: Callable[[SessionEvent], None] | None,
    ) -> None:
        self.stream_id = opening.stream_id
        self._lossless = opening.delivery == codec.delivery_to_proto(Delivery.EVERY)
        self._encoding = encoding
        self._jpeg_quality = jpeg_quality
        self._answers = Answers()
        self._link = Link(transport, opening, self._answers, on_event)
        self._turn = asyncio.Lock()
        self._next_id = 1

    async def __aenter__(self) -> Self:
        await self._link.open()
        self._next_id = self._answers.opened.last_frame_id + 1
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        await self._link.close()

    @property
    def resume_token(self) -> bytes:
        """With the stream id, what another session needs to take this stream over."""
        return self._answers.opened.resume_token

    @property
    def rig(self) -> RectifiedRig:
        """The rig of every result: the one that was sent, or its rectification."""
        return self._answers.rig

    @property
    def model(self) -> ModelInfo:
        return ModelInfo.from_proto(self._answers.opened.model)

    @property
    def credit(self) -> int:
        """Frames that may be unanswered at once."""
        return self._answers.flights.credit

    @property
    def drops(self) -> Drops:
        return self._answers.flights.drops

    @property
    def round_trip_s(self) -> float | None:
        """Of the latest clock ping, without the time the server held it; None before the first."""
        return self._link.round_trip_s

    def submit(
        self,
        left: NDArray[np.uint8],
        right: NDArray[np.uint8],
        world_from_left: WorldFromLeft = None,
        *,
        capture_ns: int | None = None,
        max_age_s: float | None = None,
    ) -> int | None:
        """Send a live frame if the credit allows, without waiting; its result comes by iteration.

        Returns the frame's id, or None if it was dropped here (``drops.at_source``) because as many
        as the credit allows are unanswered, or because the connection is being made again.
        ``capture_ns`` is time.monotonic_ns() at mid-exposure (default: now). A frame that waits in
        the server for longer than ``max_age_s`` is not stepped (``drops.stale``).

        Raises BadImage, BadPose: what no server would take. Raises the error that ended the stream.
        """
        if self._lossless:
            raise RuntimeError("submit() may drop frames and this session is lossless: use step()")
        self._check_open()
        if not (self._link.up and self._answers.flights.has_room):
            self._answers.flights.count(at_source=1)
            return None
        request = self._request(left, right, world_from_left, capture_ns, max_age_s)
        return self._launch(request, answer=None)

    async def step(
        self,
        left: NDArray[np.uint8],
        right: NDArray[np.uint8],
        world_from_left: WorldFromLeft = None,
        *,
        capture_ns: int | None = None,
    ) -> DepthResult:
        """Send a frame and wait for its answer; calls that overlap go out in order.

        Overlapping as many calls as the credit keeps the server busy while frames travel.
        Raises the error of this frame, or the one that ended the stream. Raises ConnectionLost: the
        server took the frame and the connection broke before the answer came.
        """
        answer: asyncio.Future[DepthResult] = asyncio.get_running_loop().create_future()
        async with self._turn:
            await self._answers.flights.room()
            self._check_open()
            request = self._request(left, right, world_from_left, capture_ns, max_age_s=None)
            self._launch(request, answer)
        return await answer

    def reset(self) -> None:
        """Frames after this start from nothing, as after a cut in a film."""
        self._check_open()
        self._answers.reset_after = self._next_id - 1
        self._link.send(RESET)

    def end(self) -> None:
        """No frame follows: iteration stops after the last answer, and the server frees the state.

        Leaving ``async with`` does this too.
        """
        self._link.end()

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> DepthResult:
        """The next result of a submitted frame; a slow reader gets the newest ones.

        Raises the error of a submitted frame in its place; the stream lives on, iterate again.
        Raises the error that ended the stream, as Superseded or StreamExpired.
        """
        return await self._answers.next()

    def _check_open(self) -> None:
        if self._answers.error is not None:
            raise self._answers.error
        if self._link.ending:
            raise RuntimeError("the session has ended; open a new one")

    def _request(
        self,
        left: NDArray[np.uint8],
        right: NDArray[np.uint8],
        world_from_left: WorldFromLeft,
        capture_ns: int | None,
        max_age_s: float | None,
    ) -> bytes:
        if isinstance(world_from_left, np.ndarray):
            world_from_left = Pose.from_matrix(world_from_left)
        if isinstance(world_from_left, Pose):
            world_from_left = PoseSample(world_from_left)
        capture_ns = time.monotonic_ns() if capture_ns is None else capture_ns
        frame = StereoFrame(self._next_id, capture_ns, left, right, world_from_left)
        return codec.frame_to_request(
            frame, encoding=self._encoding, jpeg_quality=self._jpeg_quality, max_age_s=max_age_s
        )

    def _launch(self, request: bytes, answer: asyncio.Future[DepthResult] | None) -> int:
        frame_id, self._next_id = self._next_id, self._next_id + 1
        self._answers.flights.launch(Flight(frame_id, request, answer))
        self._link.send(request)
        return frame_id
