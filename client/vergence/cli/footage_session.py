"""How the commands open a session for footage, and how they read it."""

import asyncio
import signal
from collections.abc import AsyncGenerator, AsyncIterator, Iterator
from contextlib import aclosing, asynccontextmanager, contextmanager, nullcontext, suppress
from dataclasses import dataclass

from vergence.cli.errors import CliError
from vergence.cli.sources import Footage
from vergence.cli.streaming import AnsweredFrame, every_frame, live_frames
from vergence.client import DepthClient
from vergence.session import DepthSession
from vergence_proto.datasets import SourceFrame
from vergence_proto.geometry import Axes
from vergence_proto.types import Delivery, ImageEncoding, OutputFormat


@dataclass(frozen=True, slots=True)
class Pace:
    """How fast frames are sent, and whether one may be left out."""

    delivery: Delivery
    rate_hz: float | None = None  # None: as fast as they come, or as the server steps them


@asynccontextmanager
async def session_for(
    client: DepthClient, footage: Footage, pace: Pace, output: OutputFormat, iterations: int
) -> AsyncIterator[DepthSession]:
    """Open a session for footage, as a recorded one was opened if it is a recording.

    ``iterations`` of a step; 0: as recorded, or the server's default.
    """
    replay = footage.replay
    cold_iterations = iterations if footage.alone else 0
    if replay is not None:
        cold_iterations = iterations or replay.cold_iterations
        iterations = iterations or replay.iterations
    await client.server_info()  # fails at once if no server is there; a session would wait for it
    async with client.open_session(
        footage.rig,
        axes=Axes.OPENCV if replay is None else replay.axes,
        delivery=pace.delivery,
        output=output.resolved(),  # every pixel, whatever the link
        encoding=ImageEncoding.RAW,
        iterations=iterations,
        cold_iterations=cold_iterations,
        # Without a frame left out, a cold start would change what is written.
        on_lost="raise" if pace.delivery is Delivery.EVERY else "restart",
    ) as session:
        yield session


def pace_of(rate: str, footage: Footage) -> Pace:
    """Parse ``--rate``. Raises CliError."""
    if footage.live:
        if rate != "max":
            raise CliError("--rate is for files; a camera has its own rate", exit_code=2)
        return Pace(Delivery.NEWEST)
    if rate == "max":
        return Pace(Delivery.EVERY)
    if rate == "source":
        if footage.fps is None:
            raise CliError(
                f"{footage.name} has no frame rate of its own: use --rate HZ or max",
                exit_code=2,
            )
        return Pace(Delivery.NEWEST, footage.fps)
    try:
        rate_hz = float(rate)
    except ValueError:
        rate_hz = 0.0
    if not 0 < rate_hz < 10_000:
        raise CliError(f"--rate: expected a rate in Hz, source or max, got {rate!r}", exit_code=2)
    return Pace(Delivery.NEWEST, rate_hz)


def answered_frames(
    session: DepthSession,
    footage: Footage,
    pace: Pace,
    frames: AsyncIterator[tuple[int, SourceFrame]],
) -> AsyncGenerator[AnsweredFrame, None]:
    """Stream the frames of footage at its pace."""
    if pace.delivery is Delivery.NEWEST:
        return live_frames(session, frames, rate_hz=pace.rate_hz)
    resets = footage.replay.resets if footage.replay is not None else ()
    return every_frame(session, frames, in_flight=session.credit, resets=resets)


async def first_frames(
    footage: Footage, count: int | None
) -> AsyncGenerator[tuple[int, SourceFrame], None]:
    """Yield the first ``count`` frames, or all; those of a camera until Ctrl-C."""
    async with aclosing(footage.frames()) as frames:
        with _interrupted() if footage.live else nullcontext(asyncio.Event()) as interrupted:
            async for index, frame in frames:
                yield index, frame
                if index + 1 == count or interrupted.is_set():
                    return


@contextmanager
def _interrupted() -> Iterator[asyncio.Event]:
    """Set the event at the first Ctrl-C; the second one ends the command."""
    event = asyncio.Event()
    loop = asyncio.get_running_loop()

    def interrupt() -> None:
        event.set()
        loop.remove_signal_handler(signal.SIGINT)

    with suppress(NotImplementedError):  # on Windows, Ctrl-C ends the command
        loop.add_signal_handler(signal.SIGINT, interrupt)
    try:
        yield event
    finally:
        with suppress(NotImplementedError):
            loop.remove_signal_handler(signal.SIGINT)
