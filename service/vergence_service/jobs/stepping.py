"""Step a whole sequence: a pure function of its frames and the model."""

import asyncio
import dataclasses
from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing
from dataclasses import dataclass
from functools import partial

from vergence_proto.datasets import DatasetError, SourceFrame, StereoSource, read_ahead
from vergence_proto.errors import BadShape, DepthError, NonFinite
from vergence_proto.ordered import in_order
from vergence_proto.types import DisparityMap, Origin
from vergence_service.access.principals import LOCAL
from vergence_service.inference.model import RecurrentState, StereoView
from vergence_service.streams.conversion import decoded_view
from vergence_service.streams.engine import DepthEngine
from vergence_service.streams.rectify import Rectifier
from vergence_service.streams.stream import Stream, StreamConfig

# One frame is in the model while the map of the frame before is made.
_IN_FLIGHT = 2
# Errors of one frame: the next one can be stepped.
FRAME_ERRORS = (BadShape, NonFinite)


@dataclass(frozen=True, slots=True, eq=False)
class Stepped:
    """One frame of a sequence and its result."""

    index: int  # position in the sequence, from 0
    source: SourceFrame
    make_map: Callable[[], DisparityMap]  # works on whole images: call it in a worker thread
    state: RecurrentState  # state after this frame
    rectifier: Rectifier
    note: DatasetError | None = None  # what is wrong with its ground truth
    make_alone: Callable[[], DisparityMap] | None = None  # the map without a state, if asked for


@dataclass(frozen=True, slots=True, eq=False)
class Skipped:
    """A frame without a result: it could not be read or stepped."""

    index: int
    error: DatasetError | DepthError


@dataclass(frozen=True, slots=True, eq=False)
class _Read:
    index: int
    source: SourceFrame
    view: StereoView | DepthError
    note: DatasetError | None


async def step_all(
    engine: DepthEngine,
    sequence: StereoSource,
    config: StreamConfig,
    *,
    start: int = 0,
    state: RecurrentState | None = None,
    may_skip: Callable[[DatasetError | DepthError], bool] = lambda _: False,
    alone: bool = False,
    owner: str = LOCAL.name,
) -> AsyncGenerator[Stepped | Skipped, None]:
    """Step the frames of ``sequence`` in order, each from the state after the frame before.

    Stepping begins at frame ``start``, from ``state``, the state after the frame before it. A frame
    that cannot be read or stepped is skipped if ``may_skip`` allows it for the error. With
    ``alone``, each frame is stepped a second time without a state.

    Raises NotReady or Draining if the server accepts no work; BadCalibration, FrameTooLarge or
    ModelFailed if a frame cannot be stepped; and what ``may_skip`` does not allow: DatasetError if
    a file cannot be read, BadShape or NonFinite if a frame cannot be stepped.
    """
    async with (
        engine.offline(config, state=state, owner=owner) as stream,
        aclosing(_reading(engine, sequence, stream, start, may_skip)) as frames,
        aclosing(
            in_order(frames, partial(_step, engine, stream, may_skip, alone), limit=_IN_FLIGHT)
        ) as (steps),
    ):
        async for stepped in steps:
            yield stepped


async def _reading(
    engine: DepthEngine,
    sequence: StereoSource,
    stream: Stream,
    start: int,
    may_skip: Callable[[DatasetError | DepthError], bool],
) -> AsyncGenerator[_Read | Skipped, None]:
    errors: dict[int, DatasetError] = {}
    views: dict[int, StereoView | DepthError] = {}

    def make_view(index: int, source: SourceFrame) -> None:
        try:
            _, views[index] = decoded_view(lambda: source.frame, stream)
        except DepthError as error:
            views[index] = error

    def note(index: int, error: DatasetError) -> None:
        if not may_skip(error):
            raise error
        errors[index] = error

    reading = read_ahead(
        sequence,
        start=start,
        in_thread=engine.threads.background.run,
        on_unreadable=note,
        on_read=make_view,
    )
    async with aclosing(reading) as frames:
        async for index, source in frames:
            own = errors.pop(index, None)
            for missing in sorted(errors):
                yield Skipped(missing, errors.pop(missing))
            yield _Read(index, source, views.pop(index), own)
    for missing in sorted(errors):
        yield Skipped(missing, errors[missing])


async def _step(
    engine: DepthEngine,
    stream: Stream,
    may_skip: Callable[[DatasetError | DepthError], bool],
    alone: bool,
    read: _Read | Skipped,
) -> Stepped | Skipped:
    if isinstance(read, Skipped):
        return read
    frame_id = read.source.frame.frame_id
    try:
        if isinstance(read.view, DepthError):
            engine.count_failed(stream, read.view)
            raise read.view
        stepped = await engine.step_view(stream, frame_id, read.view)
        state, second = stepped.result.state, None
        if alone and state.step_count > 1:
            second = await engine.step_view(_without_state(stream), frame_id, read.view)
    except FRAME_ERRORS as error:
        if not may_skip(error):
            raise
        return Skipped(read.index, error)
    return Stepped(
        read.index,
        read.source,
        stepped.disparity_map,
        state,
        stream.rectifier,
        read.note,
        None if second is None else second.disparity_map,
    )


def _without_state(stream: Stream) -> Stream:
    """Return a stream whose next frame is stepped as if it were the first."""
    return dataclasses.replace(
        stream,
        state=None,
        origin=Origin.COLD_START,
        last_frame_id=0,
        frames_skipped=0,
        turn=asyncio.Lock(),
    )
