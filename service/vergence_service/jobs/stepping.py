"""Step a whole sequence: a pure function of its frames and the model."""

from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing
from dataclasses import dataclass
from functools import partial

from vergence_proto.datasets import DatasetError, SourceFrame, StereoSource, read_ahead
from vergence_proto.ordered import in_order
from vergence_proto.types import DisparityMap
from vergence_service.inference.model import RecurrentState
from vergence_service.streams.engine import DepthEngine
from vergence_service.streams.stream import Stream, StreamConfig

# One frame is in the model while the map of the frame before is made.
_IN_FLIGHT = 2


@dataclass(frozen=True, slots=True, eq=False)
class Stepped:
    """One frame of a sequence and its result."""

    index: int  # position in the sequence, from 0
    source: SourceFrame
    disparity: DisparityMap
    state: RecurrentState  # state after this frame


async def step_all(
    engine: DepthEngine,
    sequence: StereoSource,
    config: StreamConfig,
    *,
    start: int = 0,
    state: RecurrentState | None = None,
    on_unreadable: Callable[[int, DatasetError], None] | None = None,
) -> AsyncGenerator[Stepped, None]:
    """Step the frames of ``sequence`` in order, each from the state after the frame before.

    Stepping begins at frame ``start``, from ``state``, the state after the frame before it. A frame
    that cannot be read is left out, and ``on_unreadable`` gets its index and the error.

    Raises NotReady or Draining if the server accepts no work; BadCalibration, FrameTooLarge,
    BadShape, ModelFailed or NonFinite if a frame cannot be stepped; and, without ``on_unreadable``,
    DatasetError if a file cannot be read.
    """
    async with (
        engine.offline(config, state=state) as stream,
        aclosing(
            read_ahead(
                sequence,
                start=start,
                in_thread=engine.threads.background.run,
                on_unreadable=on_unreadable,
            )
        ) as frames,
        aclosing(in_order(frames, partial(_step, engine, stream), limit=_IN_FLIGHT)) as steps,
    ):
        async for stepped in steps:
            yield stepped


async def _step(engine: DepthEngine, stream: Stream, frame: tuple[int, SourceFrame]) -> Stepped:
    index, source = frame
    disparity, state = await engine.step_offline(stream, lambda: source.frame)
    return Stepped(index, source, disparity, state)
