"""Streams that note every answer, for a fleet that is disturbed meanwhile."""

import asyncio
import hashlib
import time
from dataclasses import dataclass, field
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vergence import (
    Delivery,
    DepthClient,
    DepthResult,
    DepthSession,
    EventKind,
    OutputFormat,
    PlaneEncoding,
    Pose,
    RectifiedRig,
    SessionEvent,
)
from vergence_proto.errors import DepthError

EXACT = OutputFormat(encoding=PlaneEncoding.FLOAT32)
IMAGES = 16  # different ones, then they repeat


@dataclass(frozen=True, slots=True)
class Answer:
    frame_id: int
    step_count: int
    digest: bytes
    time_s: float


@dataclass(slots=True, eq=False)
class StreamLog:
    """What one session has seen."""

    number: int
    lossless: bool
    answers: list[Answer] = field(default_factory=list)
    sent: set[int] = field(default_factory=set)
    events: list[tuple[float, EventKind]] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)

    @property
    def delivery(self) -> Delivery:
        return Delivery.EVERY if self.lossless else Delivery.NEWEST

    def note(self, result: DepthResult) -> None:
        self.answers.append(
            Answer(result.frame_id, result.step_count, digest_of(result), time.monotonic())
        )

    def event(self, event: SessionEvent) -> None:
        self.events.append((time.monotonic(), event.kind))

    def had(self, kind: EventKind, from_s: float, to_s: float) -> bool:
        return any(kind is each and from_s <= at_s < to_s for at_s, each in self.events)

    def gap_s(self, from_s: float, to_s: float) -> float:
        times = [each.time_s for each in self.answers if from_s - 1.0 <= each.time_s < to_s]
        return max(
            (later - earlier for earlier, later in pairwise(times)),
            default=to_s - from_s,
        )


def digest_of(result: DepthResult) -> bytes:
    return hashlib.sha256(result.disparity_px.tobytes()).digest()


def rig_of(width: int, height: int) -> RectifiedRig:
    middle = ((width - 1) / 2, (height - 1) / 2)
    return RectifiedRig(
        width, height, 0.8 * width, 0.8 * width, middle[0], middle[0], middle[1], 0.1
    )


@cache
def image(number: int, index: int, width: int, height: int) -> NDArray[np.uint8]:
    seed = number * IMAGES + index
    return np.random.default_rng(seed).integers(0, 256, (height, width + 12), np.uint8)


async def step(session: DepthSession, number: int, frame_id: int, size: tuple[int, int]) -> Any:
    return await session.step(*pair(number, frame_id, size), capture_ns=frame_id * 100_000_000)


def pair(number: int, frame_id: int, size: tuple[int, int]) -> tuple[Any, Any, Pose]:
    wide = image(number, frame_id % IMAGES, *size)
    pose = Pose(np.eye(3), np.array([0.01 * frame_id, 0.0, 0.0]))
    return wide[:, 12:], wide[:, :-12], pose


class Load:
    """The streams, at one rate, until they are asked to end."""

    def __init__(self, address: str, *, streams: int, hz: float, size: tuple[int, int]) -> None:
        self.logs = [StreamLog(number, number % 2 == 0) for number in range(streams)]
        self._address = address
        self._hz = hz
        self._size = size
        self._end = asyncio.Event()

    async def run(self) -> None:
        async with DepthClient(self._address) as client, asyncio.TaskGroup() as tasks:
            for log in self.logs:
                tasks.create_task(self._stream(client, log))

    def end(self) -> None:
        self._end.set()

    async def _stream(self, client: DepthClient, log: StreamLog) -> None:
        await asyncio.sleep(log.number / self._hz / len(self.logs))
        async with client.open_session(
            rig_of(*self._size),
            delivery=log.delivery,
            output=EXACT,
            on_event=log.event,
            stream_id=f"camera-{log.number}",
        ) as session:
            await (self._lossless if log.lossless else self._live)(session, log)

    async def _lossless(self, session: DepthSession, log: StreamLog) -> None:
        frame_id, next_s = 0, time.monotonic()
        while not self._end.is_set():
            frame_id += 1
            log.sent.add(frame_id)
            try:
                log.note(await step(session, log.number, frame_id, self._size))
            except DepthError as error:
                log.errors.append(f"frame {frame_id}: {error.code} {error}")
            next_s = max(next_s + 1 / self._hz, time.monotonic() - 1.0)
            await asyncio.sleep(next_s - time.monotonic())

    async def _live(self, session: DepthSession, log: StreamLog) -> None:
        async def read() -> None:
            async for result in session:
                log.note(result)

        reading = asyncio.create_task(read())
        next_id, next_s = 1, time.monotonic()
        while not self._end.is_set():
            # The content follows from the id, and the next id is known only after a frame is sent.
            sent = session.submit(
                *pair(log.number, next_id, self._size), capture_ns=next_id * 100_000_000
            )
            if sent:
                log.sent.add(next_id)
                next_id += 1
            next_s += 1 / self._hz
            await asyncio.sleep(max(next_s - time.monotonic(), 0.0))
        session.end()
        await reading
