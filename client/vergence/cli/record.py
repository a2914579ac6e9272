"""``vergence record``: stream a source, and write the session into an MCAP file."""

import time
from collections.abc import Sequence
from contextlib import aclosing
from pathlib import Path

from rich.console import Console

from vergence.cli.errors import CliError
from vergence.cli.footage_session import (
    Pace,
    answered_frames,
    first_frames,
    pace_of,
    session_for,
)
from vergence.cli.local_server import server_for
from vergence.cli.progress import progress_bar
from vergence.cli.report import Report
from vergence.cli.sources import CalibrationFlags, Footage, footage_at
from vergence.client import DepthClient
from vergence.session import DepthSession
from vergence_proto.types import OutputFormat


async def record(
    sources: Sequence[str],
    path: Path,
    calibration: CalibrationFlags,
    *,
    server: str | None,
    rate: str,
    frames: int | None,
    console: Console,
) -> None:
    """Stream a source; write images, poses, calibration and depth of each answered frame."""
    footage = footage_at(sources, calibration)
    pace = pace_of(rate, footage)
    count = frames if footage.count is None else min(frames or footage.count, footage.count)
    pixels = footage.rig.left.width * footage.rig.left.height
    async with (
        server_for(server, console, pixels=pixels) as address,
        DepthClient(address) as client,
        session_for(client, footage, pace, OutputFormat(), 0) as session,
    ):
        try:
            recording = session.record(path)
        except ImportError as error:
            raise CliError(str(error), exit_code=2) from None
        with recording:
            report = await _stream(session, footage, pace, count, console)
    if recording.frames_left_out:
        console.print(
            f"[yellow]note[/]       {recording.frames_left_out} frames are not in the file: "
            "the disk was too slow"
        )
    console.print(report.as_table(footage.name))
    console.print(f"recording  {path}: {recording.frames} frames; vergence run {path} replays it")


async def _stream(
    session: DepthSession, footage: Footage, pace: Pace, count: int | None, console: Console
) -> Report:
    report = Report()
    frames = first_frames(footage, count)
    stream = answered_frames(session, footage, pace, frames)
    with progress_bar(console) as progress:
        bar = progress.add_task("recording", total=count, note="")
        started_s = time.monotonic()
        async with aclosing(frames), aclosing(stream):
            async for answered in stream:
                note = f"{1e3 * answered.latency_s:.0f} ms"
                progress.update(bar, completed=answered.index + 1, note=note)
                report.add(answered.latency_s, answered.result.timings.model_s, answered.accuracy())
        report.seconds = time.monotonic() - started_s
    report.drops = session.drops
    report.frames_unread = len(footage.unread)
    return report
