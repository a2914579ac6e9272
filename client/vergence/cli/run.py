"""``vergence run``: stream a sequence or a pair from disk, write disparity and figures."""

import asyncio
import time
from collections.abc import AsyncGenerator
from contextlib import aclosing
from pathlib import Path

from rich.console import Console
from rich.progress import TaskID

from vergence.cli.captions import row_of, shown_in_sheet, title_of, write_sheet
from vergence.cli.errors import CliError
from vergence.cli.json_file import write_json
from vergence.cli.local_server import server_for
from vergence.cli.pictures import Row
from vergence.cli.progress import progress_bar
from vergence.cli.report import Report
from vergence.cli.sources import source_at
from vergence.cli.streaming import AnsweredFrame, every_frame, live_frames
from vergence.client import DepthClient
from vergence.session import DepthSession
from vergence_proto.accuracy import Accuracy
from vergence_proto.datasets import DatasetError, StereoSource, read_ahead, write_disparity_png
from vergence_proto.ordered import in_order
from vergence_proto.types import Delivery

# So many files may be in writing while the next frames are stepped.
_WRITES_AT_ONCE = 4


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
    """Stream a source; write one disparity PNG per answered frame, and pictures if requested."""
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
        results = _Results(directory, alone=alone, kept=shown_in_sheet(len(source)))
        try:
            report = await _stream(session, source, rate_hz, results, console)
        except DatasetError as error:  # a file in the middle of the sequence
            raise CliError(str(error), exit_code=2) from None
    if pictures and results.rows:
        write_sheet(directory / "sheet.png", title, results.rows)
        console.print(f"picture    {directory / 'sheet.png'}")
    console.print(f"disparity  {directory}")
    console.print(report.as_table(title))
    if json is not None:
        write_json(json, report.as_json())


def _rate_hz(rate: str, source: StereoSource) -> float | None:
    """Parse ``--rate``; None means lossless, at the speed of the server. Raises CliError."""
    if rate == "max":
        return None
    if rate == "source":
        if source.fps is None:
            raise CliError(
                f"{source.name} has no frame rate of its own: use --rate HZ or max",
                exit_code=2,
            )
        return source.fps
    try:
        rate_hz = float(rate)
    except ValueError:
        rate_hz = 0.0
    if not 0 < rate_hz < 10_000:
        raise CliError(f"--rate: expected a rate in Hz, source or max, got {rate!r}", exit_code=2)
    return rate_hz


class _Results:
    """Write one file per frame, and keep the rows of the sheet."""

    def __init__(self, directory: Path, *, alone: bool, kept: list[int]) -> None:
        self._directory = directory
        self._alone = alone
        self._kept = kept
        self.rows: list[Row] = []

    def write(self, answered: AnsweredFrame) -> tuple[AnsweredFrame, Accuracy | None]:
        """Write and score a frame, in a thread: both may take longer than a step."""
        name = "disp.png" if self._alone else f"{answered.index:04d}.png"
        write_disparity_png(self._directory / name, answered.result.offset_px)
        return answered, answered.accuracy()

    def keep_row(self, answered: AnsweredFrame) -> None:
        # Frames may have been dropped: the first one at or after each place is shown.
        if self._kept and answered.index >= self._kept[0]:
            self._kept = [index for index in self._kept if index > answered.index]
            self.rows.append(row_of(answered))


async def _stream(
    session: DepthSession,
    source: StereoSource,
    rate_hz: float | None,
    results: _Results,
    console: Console,
) -> Report:
    report = Report()
    frames = read_ahead(source)
    if rate_hz is None:
        stream = every_frame(session, frames, in_flight=session.credit)
    else:
        stream = live_frames(session, frames, rate_hz=rate_hz)

    async def noted(bar: TaskID) -> AsyncGenerator[AnsweredFrame, None]:
        async for answered in stream:
            note = f"{1e3 * answered.latency_s:.0f} ms"
            progress.update(bar, completed=answered.index + 1, note=note)
            yield answered
        report.seconds = time.monotonic() - started_s

    async def write(answered: AnsweredFrame) -> tuple[AnsweredFrame, Accuracy | None]:
        return await asyncio.to_thread(results.write, answered)

    with progress_bar(console) as progress:
        bar = progress.add_task("streaming", total=len(source), note="")
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
