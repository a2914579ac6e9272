"""``vergence run``: stream files or a camera, write disparity and figures."""

import asyncio
import time
from collections.abc import AsyncGenerator, Iterator, Sequence
from contextlib import aclosing
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.progress import TaskID

from vergence.cli.captions import row_of, shown_in_sheet, title_of, write_sheet
from vergence.cli.errors import CliError
from vergence.cli.footage_session import (
    Pace,
    answered_frames,
    first_frames,
    pace_of,
    session_for,
)
from vergence.cli.json_file import write_json
from vergence.cli.local_server import server_for
from vergence.cli.pictures import Row
from vergence.cli.progress import progress_bar
from vergence.cli.report import Report
from vergence.cli.result_folder import Files, KeptValues, ResultFolder, make_room
from vergence.cli.sources import CalibrationFlags, Footage, footage_at
from vergence.cli.streaming import AnsweredFrame
from vergence.client import DepthClient
from vergence.session import DepthSession
from vergence.transports.addresses import on_this_machine
from vergence_proto.accuracy import Accuracy
from vergence_proto.jobs import Output
from vergence_proto.ordered import in_order
from vergence_proto.types import OutputFormat

# So many files may be in writing while the next frames are stepped.
_WRITES_AT_ONCE = 4
_NAMED_AT_MOST = 10


async def run(
    sources: Sequence[str],
    calibration: CalibrationFlags,
    *,
    server: str | None,
    out: Path | None,
    rate: str,
    frames: int | None,
    iterations: int,
    files: Files,
    pictures: bool | None,
    json: Path | None,
    console: Console,
) -> None:
    """Stream a source; write the maps of each answered frame.

    Pictures are drawn if requested; None: of images and cameras without a calibration of their own.
    """
    footage = footage_at(sources, calibration)
    pace = pace_of(rate, footage)
    drawn = footage.loose if pictures is None else pictures
    count = frames if footage.count is None else min(frames or footage.count, footage.count)
    directory = out or Path("vergence-run") / footage.name
    outputs = _outputs(files, footage)
    make_room(directory)
    folder = ResultFolder(directory, outputs=outputs, form=files.form, alone=footage.alone)
    results = _Results(folder, files.kept, kept=shown_in_sheet(count))
    for note in _notes(footage):
        console.print(f"[yellow]note[/]       {note}")
    async with (
        server_for(
            server, console, pixels=footage.rig.left.width * footage.rig.left.height
        ) as address,
        DepthClient(address) as client,
        session_for(
            client,
            footage,
            pace,
            OutputFormat(
                confidence=Output.CONFIDENCE in outputs or files.kept.min_confidence > 0,
                sigma=Output.SIGMA in outputs or drawn,
                compressed=not on_this_machine(address),
            ),
            iterations,
        ) as session,
    ):
        title = title_of(footage.name, footage.rig, session.model.name)
        rig = session.rig if footage.metric else None
        folder.begin(session.rig)
        report = await _stream(session, footage, pace, count, results, console)
    if drawn and results.rows:
        write_sheet(directory / "sheet.png", title, results.rows, rig)
        console.print(f"picture    {directory / 'sheet.png'}")
    console.print(f"{'results':<10} {directory}: {', '.join(outputs)}")
    console.print(report.as_table(title))
    for note in _notes_after(report, folder):
        console.print(f"[yellow]note[/]       {note}")
    if json is not None:
        write_json(json, report.as_json())
    _check_unread(footage, report)


def _outputs(files: Files, footage: Footage) -> tuple[Output, ...]:
    """Return the maps to write. Raises CliError: depth was requested, and there is none."""
    usual = (Output.DISPARITY, Output.DEPTH) if footage.has_depth else (Output.DISPARITY,)
    outputs = tuple(dict.fromkeys(files.outputs)) or usual
    if not footage.metric and (Output.DEPTH in outputs or files.kept.limits_depth):
        raise CliError(
            f"{footage.name} has no calibration in metres, so it has no depth", exit_code=2
        )
    return outputs


def _notes_after(report: Report, folder: ResultFolder) -> Iterator[str]:
    if folder.beyond:
        yield (
            f"{folder.beyond} values of 256 and more do not fit a 16-bit PNG and are left out; "
            "--format pfm or npz keeps them"
        )
    if report.accuracies and report.accuracy is None:
        yield "the ground truth has no value in any frame, so there is nothing to compare with"


def _check_unread(footage: Footage, report: Report) -> None:
    """Raise CliError if a file could not be read; everything else is written by then."""
    if not footage.unread:
        return
    named = "".join(f"\n  {why}" for why in list(footage.unread.values())[:_NAMED_AT_MOST])
    more = len(footage.unread) - _NAMED_AT_MOST
    rest = f"\n  and {more} more" if more > 0 else ""
    if not report.latencies_s:
        raise CliError(f"no frame could be read:{named}{rest}", exit_code=2)
    raise CliError(
        f"{len(footage.unread)} of {footage.count} frames lack a file; the results of all others "
        f"are written:{named}{rest}"
    )


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


class _Results:
    """Filter and write one result per frame, and keep the rows of the sheet."""

    def __init__(self, folder: ResultFolder, kept_values: KeptValues, *, kept: list[int]) -> None:
        self._folder = folder
        self._kept_values = kept_values
        self._kept = kept
        self.rows: list[Row] = []

    def write(self, answered: AnsweredFrame) -> tuple[AnsweredFrame, Accuracy | None, float]:
        """Write and score a frame, in a thread: both may take longer than a step.

        Returns the filtered frame, its accuracy before the filters, and the share of its values
        that they kept.
        """
        found = answered.accuracy()
        result = self._kept_values.of(answered.result)
        self._folder.write(answered.index, result)
        share = float(result.valid.sum() / max(answered.result.valid.sum(), 1))
        return replace(answered, result=result), found, share

    def keep_row(self, answered: AnsweredFrame) -> None:
        # Frames may have been dropped: the first one at or after each place is shown.
        if self._kept and answered.index >= self._kept[0]:
            self._kept = [index for index in self._kept if index > answered.index]
            self.rows.append(row_of(answered))


async def _stream(
    session: DepthSession,
    footage: Footage,
    pace: Pace,
    count: int | None,
    results: _Results,
    console: Console,
) -> Report:
    report = Report()
    frames = first_frames(footage, count)
    stream = answered_frames(session, footage, pace, frames)

    async def noted(bar: TaskID) -> AsyncGenerator[AnsweredFrame, None]:
        async for answered in stream:
            note = f"{1e3 * answered.latency_s:.0f} ms"
            progress.update(bar, completed=answered.index + 1, note=note)
            yield answered
        report.seconds = time.monotonic() - started_s

    async def write(answered: AnsweredFrame) -> tuple[AnsweredFrame, Accuracy | None, float]:
        return await asyncio.to_thread(results.write, answered)

    with progress_bar(console) as progress:
        bar = progress.add_task("streaming", total=count, note="")
        started_s = time.monotonic()
        # A cancelled task cannot stop its thread, so writes that have begun are awaited.
        noting = noted(bar)
        writing = in_order(noting, write, limit=_WRITES_AT_ONCE, cancel_rest=False)
        async with aclosing(frames), aclosing(stream), aclosing(noting), aclosing(writing):
            async for answered, found, share in writing:
                report.add(answered.latency_s, answered.result.timings.model_s, found)
                report.kept_shares.append(share)
                results.keep_row(answered)
    report.drops = session.drops
    report.frames_unread = len(footage.unread)
    return report
