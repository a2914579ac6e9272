"""``vergence run``: a sequence or a pair from disk to disparity files, and to figures."""

import asyncio
import time
from collections import deque
from contextlib import aclosing
from pathlib import Path

from rich.console import Console

from vergence.cli.errors import Trouble
from vergence.cli.pictures import Row
from vergence.cli.play import (
    accuracy_of,
    progress_bar,
    row_of,
    server_for,
    shown_in_sheet,
    source_at,
    title_of,
    write_json,
    write_sheet,
)
from vergence.cli.report import Report
from vergence.cli.streaming import Answered, every_frame, live_frames
from vergence.client import DepthClient
from vergence.session import DepthSession
from vergence_proto.accuracy import Accuracy
from vergence_proto.datasets import DatasetError, StereoSource, read_ahead, write_disparity_png
from vergence_proto.types import Delivery

# Files being written while the next frames are stepped.
_UNWRITTEN = 4


async def run(
    source_text: str,
    *,
    server: str | None,
    out: Path | None,
    rate: str,
    iterations: int,
    pictures: bool,
    json: Path | None,
    console: Console,
) -> None:
    """Stream a source; write one disparity PNG per answered frame, and what else is asked for."""
    source = source_at(source_text)
    rate_hz = _rate_hz(rate, source)
    directory = out or Path("vergence-run") / source.name
    directory.mkdir(parents=True, exist_ok=True)
    alone = source.is_single_pair
    async with (
        server_for(server, console) as address,
        DepthClient(address) as client,
        client.open_session(
            source.rig,
            delivery=Delivery.EVERY if rate_hz is None else Delivery.NEWEST,
            iterations=iterations,
            cold_iterations=iterations if alone else 0,
        ) as session,
    ):
        title = title_of(source, session.model.name)
        written = _Written(directory, alone=alone, kept=shown_in_sheet(len(source)))
        try:
            report = await _stream(session, source, rate_hz, written, console)
        except DatasetError as error:  # a file in the middle of the sequence
            raise Trouble(str(error), exit_code=2) from None
    if pictures and written.rows:
        write_sheet(directory / "sheet.png", title, written.rows)
        console.print(f"picture    {directory / 'sheet.png'}")
    console.print(f"disparity  {directory}")
    console.print(report.as_table(title))
    if json is not None:
        write_json(json, report.as_json())


def _rate_hz(rate: str, source: StereoSource) -> float | None:
    """None: as quickly as the server answers, without a loss. Raises Trouble."""
    if rate == "max":
        return None
    if rate == "source":
        if source.fps is None:
            raise Trouble(
                f"{source.name} does not say at what rate it was filmed: give --rate HZ or max",
                exit_code=2,
            )
        return source.fps
    try:
        rate_hz = float(rate)
    except ValueError:
        rate_hz = 0.0
    if not 0 < rate_hz < 10_000:
        raise Trouble(f"--rate: expected a rate in Hz, source or max, got {rate!r}", exit_code=2)
    return rate_hz


class _Written:
    """Writes one file a frame, and keeps the rows of the sheet."""

    def __init__(self, directory: Path, *, alone: bool, kept: list[int]) -> None:
        self._directory = directory
        self._alone = alone
        self._kept = kept
        self.rows: list[Row] = []

    def write(self, answered: Answered) -> tuple[Answered, Accuracy | None]:
        """Runs in a thread: compressing and comparing take longer than stepping."""
        name = "disp.png" if self._alone else f"{answered.index:04d}.png"
        write_disparity_png(self._directory / name, answered.result.offset_px)
        return answered, accuracy_of(answered)

    def keep(self, answered: Answered) -> None:
        # Frames may have been dropped: the first one at or after each place is shown.
        if self._kept and answered.index >= self._kept[0]:
            self._kept = [index for index in self._kept if index > answered.index]
            self.rows.append(row_of(answered))


async def _stream(
    session: DepthSession,
    source: StereoSource,
    rate_hz: float | None,
    written: _Written,
    console: Console,
) -> Report:
    report = Report()
    frames = read_ahead(source)
    if rate_hz is None:
        stream = every_frame(session, frames, in_flight=session.credit)
    else:
        stream = live_frames(session, frames, rate_hz=rate_hz)
    writing: deque[asyncio.Task[tuple[Answered, Accuracy | None]]] = deque()

    async def settle() -> None:
        answered, found = await writing.popleft()
        report.add(answered.latency_s, answered.result.timings.model_s, found)
        written.keep(answered)

    with progress_bar(console) as progress:
        bar = progress.add_task("streaming", total=len(source), note="")
        started_s = time.monotonic()
        async with aclosing(frames), aclosing(stream):
            async for answered in stream:
                if len(writing) == _UNWRITTEN:
                    await settle()
                writing.append(asyncio.create_task(asyncio.to_thread(written.write, answered)))
                note = f"{1e3 * answered.latency_s:.0f} ms"
                progress.update(bar, completed=answered.index + 1, note=note)
        report.seconds = time.monotonic() - started_s
        while writing:
            await settle()
    report.drops = session.drops
    return report
