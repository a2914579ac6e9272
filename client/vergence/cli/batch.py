"""``vergence batch``: upload sequences, and download their results."""

import asyncio
import math
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
from rich.console import Console
from rich.progress import Progress, TaskID
from rich.table import Table

from vergence.cli.errors import CliError
from vergence.cli.json_file import write_json
from vergence.cli.local_server import local_server
from vergence.cli.progress import progress_bar
from vergence.cli.result_folder import make_room
from vergence.cli.sequence_jobs import Job, Query, SequenceService
from vergence.cli.uploads import Upload, find_uploads
from vergence.transports.addresses import is_private
from vergence.transports.credentials import Credentials
from vergence.transports.http import http_client
from vergence_proto.errors import DepthError
from vergence_proto.jobs import JobState, ResultFormat

# So many are packed and sent at once; the server runs them one after the other.
_AT_ONCE = 3
_CONNECT_S = 10.0
# A server of one's own takes any image; what an archive holds shows only there.
_LARGEST_PIXELS = 50_000_000


@dataclass(frozen=True, slots=True)
class Outcome:
    """The end of one upload: its job, and its error if it failed."""

    name: str
    job: Job | None  # None: the server refused the upload
    error: str | None = None


async def batch(
    paths: Sequence[Path],
    *,
    server: str | None,
    out: Path,
    form: str,
    query: Query,
    json: Path | None,
    console: Console,
) -> None:
    """Upload every sequence at ``paths`` and write its result to OUT/NAME.

    Raises CliError: there is nothing to send, no server, or (at the end) some sequences failed.
    """
    uploads = find_uploads(list(paths))
    if form != ResultFormat.MP4:
        for upload in uploads:
            make_room(out / upload.name)
    if server is None:
        async with local_server(scheme="http", pixels=_LARGEST_PIXELS) as address:
            outcomes, seconds = await _send(uploads, address, out, form, query, console)
    else:
        address = server if "://" in server else f"http://{server}"
        outcomes, seconds = await _send(uploads, address, out, form, query, console)
    console.print(f"results    {out}")
    console.print(_table(outcomes, seconds))
    for each in outcomes:
        for note in each.job.notes if each.job else ():
            console.print(f"[yellow]note[/]       {each.name}: {note}", soft_wrap=True)
    if json is not None:
        write_json(json, _figures(outcomes, seconds))
    failed = [outcome for outcome in outcomes if outcome.error]
    if failed:
        raise CliError(f"{len(failed)} of {len(outcomes)} sequences failed; the table says why")
    if unread := sum(outcome.job.frames_failed for outcome in outcomes if outcome.job):
        raise CliError(f"{unread} frames have no map; the results of all others are written")


async def _send(
    uploads: Sequence[Upload],
    address: str,
    out: Path,
    form: str,
    query: Query,
    console: Console,
) -> tuple[list[Outcome], float]:
    started_s = time.monotonic()
    # Only connecting is bounded: the length of an upload is not known.
    timeout = httpx.Timeout(None, connect=_CONNECT_S)
    shown = Credentials.of(None, None, None, None, private=is_private(address))
    with progress_bar(console) as progress, tempfile.TemporaryDirectory() as scratch:
        async with http_client(
            address, timeout=timeout, headers=dict(shown.headers), verify=shown.tls()
        ) as http:
            service = SequenceService(http)
            places = asyncio.Semaphore(_AT_ONCE)

            async def one(upload: Upload) -> Outcome:
                async with places:
                    bar = progress.add_task(upload.name, total=None, note="uploading")
                    try:
                        job = await _run(service, upload, Path(scratch), query, progress, bar)
                        if job.state is JobState.FAILED:
                            return Outcome(upload.name, job, f"{job.reason}: {job.message}")
                        await service.fetch(job, form, out / upload.name)
                        await service.forget(job)
                        return Outcome(upload.name, job)
                    except DepthError as error:
                        return Outcome(upload.name, None, f"{error.code}: {error}")
                    finally:
                        progress.remove_task(bar)

            outcomes = await asyncio.gather(*map(one, uploads))
    return outcomes, time.monotonic() - started_s


async def _run(
    service: SequenceService,
    upload: Upload,
    scratch: Path,
    query: Query,
    progress: Progress,
    bar: TaskID,
) -> Job:
    """Upload and wait until the job has ended."""
    source: Query = {} if upload.source is None else {"source": upload.source}
    archive = await asyncio.to_thread(upload.pack, scratch)
    job = await service.submit(archive, {**query, **source})
    if archive != upload.path:
        archive.unlink()
    async for job in service.watch(job):  # noqa: B020  the last one is returned
        ahead = f"{job.ahead} before it" if job.ahead else job.state
        note = f"{job.fps:.1f} fps" if job.fps else ahead
        progress.update(bar, completed=job.frames_done, total=job.frames, note=note)
    return job


def _frames(outcomes: Sequence[Outcome]) -> int:
    return sum(each.job.frames for each in outcomes if each.job and not each.error)


def _figures(outcomes: Sequence[Outcome], seconds: float) -> Mapping[str, Any]:
    frames = _frames(outcomes)
    return {
        "sequences": len(outcomes),
        "failed": sum(each.error is not None for each in outcomes),
        "frames": frames,
        "seconds": seconds,
        "fps": frames / seconds,
        "results": {
            each.name: {
                "frames": each.job.frames if each.job else 0,
                "fps": each.job.fps if each.job else None,
                "accuracy": each.job.accuracy if each.job else None,
                "frames_failed": each.job.frames_failed if each.job else 0,
                "error": each.error,
            }
            for each in outcomes
        },
    }


def _table(outcomes: Sequence[Outcome], seconds: float) -> Table:
    title = f"{len(outcomes)} sequences, {_frames(outcomes)} frames in {seconds:.1f} s"
    table = Table("sequence", title=title, title_justify="left")
    for name in ("frames", "fps", "EPE px", "D1 %"):
        table.add_column(name, justify="right")
    failed = any(each.error for each in outcomes)
    if failed:
        table.add_column("error")
    for each in outcomes:
        job = each.job
        accuracy = (job.accuracy if job else None) or {}
        numbers = (job.fps if job else None, accuracy.get("epe_px"), accuracy.get("d1_pct"))
        table.add_row(
            each.name,
            str(job.frames) if job else "",
            *(f"{value:.2f}" if value and math.isfinite(value) else "" for value in numbers),
            *([each.error or ""] if failed else []),
        )
    return table
