"""``vergence doctor --server``: stream a sample for some seconds, and say what to expect."""

import asyncio
import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from rich.console import Console

from vergence.cli.demo import bundled_sample
from vergence.cli.progress import progress_bar
from vergence.client import DepthClient
from vergence.link import LinkState
from vergence.session import DepthSession
from vergence_proto.datasets import SourceFrame, open_source
from vergence_proto.types import Delivery

CAMERA_HZ = 30.0
_FRAMES_READ = 16
_OLD_S = 0.15  # at 30 degrees a second a head has turned by 4.5 degrees
_STALL_S = 0.3
_FEW = 0.9  # of the camera's rate
_LONG_ROUND_TRIP_S = 0.06


@dataclass(frozen=True, slots=True)
class LinkFigures:
    """What a test stream measured. Times are in seconds."""

    open_s: float
    """Time to open a session: connections, and the answer of the server."""
    round_trip_s: float | None
    """Network time there and back; without queues if the link was measured."""
    results_hz: float
    """Results per second."""
    ages_s: list[float] = field(repr=False)
    """Time from capture to result, of each result."""
    longest_silence_s: float
    """The longest time between two results."""
    sent: int
    """Frames that the camera made."""
    link: LinkState
    """What the session chose at the end."""

    def age_s(self, percentile: float) -> float:
        """Return a percentile of the ages; NaN if nothing was answered."""
        return float(np.percentile(self.ages_s, percentile)) if self.ages_s else float("nan")


async def measure_link(server: str, seconds: float, console: Console) -> LinkFigures:
    """Stream the bundled sample live at 30 Hz, as a headset would.

    Raises DepthError: the server cannot be reached, or refuses the stream.
    """
    source = open_source(bundled_sample()).without_truth()
    frames = [source[index] for index in range(min(len(source), _FRAMES_READ))]
    async with DepthClient(server) as client:
        started_s = time.monotonic()
        async with client.open_session(source.rig, delivery=Delivery.NEWEST) as session:
            open_s = time.monotonic() - started_s
            with progress_bar(console) as progress:
                bar = progress.add_task(
                    "testing the link", total=round(seconds * CAMERA_HZ), note=""
                )
                arrivals, ages_s, sent = await _film(
                    session, frames, seconds, lambda: progress.advance(bar)
                )
            link = session.link
            round_trip_s = link.path_round_trip_s or session.round_trip_s
    return LinkFigures(
        open_s,
        round_trip_s,
        (len(arrivals) - 1) / (arrivals[-1] - arrivals[0]) if len(arrivals) > 1 else 0.0,
        ages_s,
        max((b - a for a, b in itertools.pairwise(arrivals)), default=seconds),
        sent,
        link,
    )


async def _film(
    session: DepthSession,
    frames: list[SourceFrame],
    seconds: float,
    on_frame: Callable[[], None],
) -> tuple[list[float], list[float], int]:
    """Film to and fro; return when results arrived, their ages, and the number of frames."""
    arrivals_s: list[float] = []
    ages_s: list[float] = []
    there_and_back = itertools.cycle((*frames, *frames[-2:0:-1]))
    count = round(seconds * CAMERA_HZ)

    async def film() -> None:
        started_s = time.monotonic()
        try:
            for index, source in zip(range(count), there_and_back, strict=False):
                await asyncio.sleep(started_s + index / CAMERA_HZ - time.monotonic())
                frame = source.frame
                session.submit(frame.left, frame.right, frame.pose)
                on_frame()
        finally:
            session.end()

    async with asyncio.TaskGroup() as tasks:
        tasks.create_task(film())
        async for result in session:
            arrivals_s.append(time.monotonic())
            ages_s.append(result.age_s)
    return arrivals_s, ages_s, count


def link_advice(figures: LinkFigures) -> Iterator[str]:
    """Say what to expect of this link, and what to set."""
    link = figures.link
    if not figures.ages_s:
        yield "no result came back: is the server overloaded, or the link down?"
        return
    yield (
        f"expect {figures.results_hz:.0f} maps a second, "
        f"{1e3 * figures.age_s(50):.0f} ms old when they arrive"
    )
    if figures.results_hz < _FEW * CAMERA_HZ:
        yield _of_the_limit(link)
    if figures.age_s(95) > _OLD_S:
        yield "show depth with session.depth_at(), which moves it to the display's pose"
    if figures.longest_silence_s > _STALL_S:
        yield (
            f"the link was silent for {figures.longest_silence_s:.1f} s: set max_age_s of "
            "depth_at() above that, and fade out what is older"
        )
    if figures.round_trip_s is not None and figures.round_trip_s > _LONG_ROUND_TRIP_S:
        yield (
            f"a round trip takes {1e3 * figures.round_trip_s:.0f} ms, and no map can be younger: "
            "use a server that is nearer"
        )


def _of_the_limit(link: LinkState) -> str:
    match link.limited_by:
        case "uplink":
            return f"the uplink is the limit{_rate(link.up_mbit_s)}: smaller images would help"
        case "downlink":
            return (
                f"the downlink is the limit{_rate(link.down_mbit_s)}: ask for fewer planes, or "
                "OutputFormat(map_step=4)"
            )
        case "server":
            took = "" if link.server_s is None else f", {1e3 * link.server_s:.0f} ms a frame"
            return f"the server is the limit{took}: use a faster one, or fewer streams on it"
        case "camera":
            return "neither the link nor the server is the limit: this machine is busy"


def _rate(mbit_s: float | None) -> str:
    return "" if mbit_s is None else f", {mbit_s:.0f} Mbit/s"
