"""``vergence run``: stream files or a camera, write disparity and figures."""

import asyncio
import signal
import time
from collections.abc import AsyncGenerator, Iterator, Sequence
from contextlib import aclosing, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.progress import TaskID

from vergence.cli.captions import WITH_SIGMA, row_of, shown_in_sheet, title_of, write_sheet
from vergence.cli.errors import CliError
from vergence.cli.json_file import write_json
from vergence.cli.local_server import server_for
from vergence.cli.pictures import Row
from vergence.cli.progress import progress_bar
from vergence.cli.report import Report
from vergence.cli.sources import CalibrationFlags, Footage, footage_at
from vergence.cli.streaming import AnsweredFrame, every_frame, live_frames
from vergence.client import DepthClient
from vergence.session import DepthSession
from vergence_proto.accuracy import Accuracy
from vergence_proto.datasets import DatasetError, SourceFrame, write_disparity_png
from vergence_proto.ordered import in_order
from vergence_proto.types import Delivery

# So many files may be in writing while the next frames are stepped.
_WRITES_AT_ONCE = 4


async def run(
    sources: Sequence[str],
    calibration: CalibrationFlags,
    *,
    server: str | None,
    out: Path | None,
    rate: str,
    frames: int | None,
    iterations: int,
    pictures: bool | None,
    json: Path | None,
    console: Console,
) -> None:
    """Stream a source; write one disparity PNG per answered frame.

    Pictures are drawn if requested; None: of images and cameras without a calibration of their own.
    """
    footage = footage_at(sources, calibration)
    pace = _pace(rate, footage)
    drawn = footage.loose if pictures is None else pictures
    count = frames if footage.count is None else min(frames or footage.count, footage.count)
    directory = out or Path("vergence-run") / footage.name
    results = _Results(directory, footage, kept=shown_in_sheet(count))
    results.make_directories()
    for note in _notes(footage):
        console.print(f"[yellow]note[/]       {note}")
    async with (
        server_for(
            server, console, pixels=footage.rig.left.width * footage.rig.left.height
        ) as address,
        DepthClient(address) as client,
        client.open_session(
            footage.rig,
            delivery=pace.delivery,
            output=WITH_SIGMA if drawn else None,
            iterations=iterations,
            cold_iterations=iterations if footage.alone else 0,
        ) as session,
    ):
        title = title_of(footage.name, footage.rig, session.model.name)
        rig = session.rig if footage.metric else None
        try:
            report = await _stream(session, footage, pace, count, results, console)
        except DatasetError as error:  # a file in the middle of the sequence
            raise CliError(str(error), exit_code=2) from None
    if drawn and results.rows:
        write_sheet(directory / "sheet.png", title, results.rows, rig)
        console.print(f"picture    {directory / 'sheet.png'}")
    console.print(f"disparity  {directory}")
    if footage.has_depth:
        console.print(f"depth      {results.depth_directory}")
    console.print(report.as_table(title))
    if json is not None:
        write_json(json, report.as_json())


def _notes(footage: Footage) -> Iterator[str]:
    yield from footage.notes
    if not footage.metric:
        yield (
            "without a calibration there is disparity in pixels, but no depth in metres; the "
            "images are taken as rectified. Name a calibration with --calib FILE, or with "
            "--fx PIXELS --baseline METRES"
        )
    if footage.count is None:
        yield "the camera is read until Ctrl-C, or for --frames N"


@dataclass(frozen=True, slots=True)
class _Pace:
    """How fast frames are sent, and whether one may be left out."""

    delivery: Delivery
    rate_hz: float | None = None  # None: as fast as they come, or as the server steps them


def _pace(rate: str, footage: Footage) -> _Pace:
    """Parse ``--rate``. Raises CliError."""
    if footage.live:
        if rate != "max":
            raise CliError("--rate is for files; a camera has its own rate", exit_code=2)
        return _Pace(Delivery.NEWEST)
    if rate == "max":
        return _Pace(Delivery.EVERY)
    if rate == "source":
        if footage.fps is None:
            raise CliError(
                f"{footage.name} has no frame rate of its own: use --rate HZ or max",
                exit_code=2,
            )
        return _Pace(Delivery.NEWEST, footage.fps)
    try:
        rate_hz = float(rate)
    except ValueError:
        rate_hz = 0.0
    if not 0 < rate_hz < 10_000:
        raise CliError(f"--rate: expected a rate in Hz, source or max, got {rate!r}", exit_code=2)
    return _Pace(Delivery.NEWEST, rate_hz)


class _Results:
    """Write one file per frame, and keep the rows of the sheet."""

    def __init__(self, directory: Path, footage: Footage, *, kept: list[int]) -> None:
        self._directory = directory
        self._footage = footage
        self._kept = kept
        self.rows: list[Row] = []

    def make_directories(self) -> None:
        self._directory.mkdir(parents=True, exist_ok=True)
        if self._footage.has_depth:
            self.depth_directory.mkdir(exist_ok=True)

    @property
    def depth_directory(self) -> Path:
        return self._directory if self._footage.alone else self._directory / "depth"

    def write(self, answered: AnsweredFrame) -> tuple[AnsweredFrame, Accuracy | None]:
        """Write and score a frame, in a thread: both may take longer than a step."""
        number = f"{answered.index:04d}.png"
        name, depth_name = ("disp.png", "depth.png") if self._footage.alone else (number, number)
        write_disparity_png(self._directory / name, answered.result.offset_px)
        if self._footage.has_depth:  # metres in the same steps of 1/256
            write_disparity_png(self.depth_directory / depth_name, answered.result.depth_m)
        return answered, answered.accuracy()

    def keep_row(self, answered: AnsweredFrame) -> None:
        # Frames may have been dropped: the first one at or after each place is shown.
        if self._kept and answered.index >= self._kept[0]:
            self._kept = [index for index in self._kept if index > answered.index]
            self.rows.append(row_of(answered))


async def _stream(
    session: DepthSession,
    footage: Footage,
    pace: _Pace,
    count: int | None,
    results: _Results,
    console: Console,
) -> Report:
    report = Report()
    frames = _first(footage, count)
    if pace.delivery is Delivery.EVERY:
        stream = every_frame(session, frames, in_flight=session.credit)
    else:
        stream = live_frames(session, frames, rate_hz=pace.rate_hz)

    async def noted(bar: TaskID) -> AsyncGenerator[AnsweredFrame, None]:
        async for answered in stream:
            note = f"{1e3 * answered.latency_s:.0f} ms"
            progress.update(bar, completed=answered.index + 1, note=note)
            yield answered
        report.seconds = time.monotonic() - started_s

    async def write(answered: AnsweredFrame) -> tuple[AnsweredFrame, Accuracy | None]:
        return await asyncio.to_thread(results.write, answered)

    with progress_bar(console) as progress:
        bar = progress.add_task("streaming", total=count, note="")
        started_s = time.monotonic()
        # A cancelled task cannot stop its thread, so writes that have begun are awaited.
        noting = noted(bar)
        writing = in_order(noting, write, limit=_WRITES_AT_ONCE, cancel_rest=False)
        async with aclosing(frames), aclosing(stream), aclosing(noting), aclosing(writing):
            async for answered, found in writing:
                report.add(answered.latency_s, answered.result.timings.model_s, found)
                results.keep_row(answered)
    report.drops = session.drops
    return report


async def _first(
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
