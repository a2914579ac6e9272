"""``vergence batch``: upload sequences, and download their results."""

import asyncio
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress, TaskID
from rich.table import Table

from vergence.cli.errors import CliError
from vergence.cli.json_file import write_json
from vergence.cli.local_server import local_server
from vergence.cli.progress import progress_bar
from vergence.cli.uploads import NamedUpload, find_uploads
from vergence.jobs.client import AsyncBatchClient
from vergence.jobs.info import JobInfo
from vergence.jobs.job import AsyncBatchJob
from vergence.jobs.saving import is_finished, make_room
from vergence.transports.base import ConnectionLost
from vergence_proto.errors import DepthError, SequenceNotDone
from vergence_proto.jobs import JobState, ResultFormat

Query = dict[str, str | int | bool | list[str]]

# So many are sent at once; the server runs them one after the other.
_AT_ONCE = 3
# A server of one's own takes any image; what an archive holds shows only there.
LARGEST_PIXELS = 50_000_000


@dataclass(frozen=True, slots=True)
class Outcome:
    """The end of one upload: its job, and its error if it failed."""

    name: str
    job: JobInfo | None  # None: the server refused the upload, or it was done before
    error: str | None = None
    skipped: bool = False  # its result was there already


@dataclass(frozen=True, slots=True)
class KeptJob:
    """A job of the server whose kept input is to be stepped again."""

    name: str


async def batch(
    paths: Sequence[Path],
    *,
    server: str | None,
    out: Path,
    form: str,
    query: Query,
    json: Path | None,
    console: Console,
    ray: str | None = None,
    again: Sequence[str] = (),
) -> None:
    """Upload every sequence at ``paths`` and write its result to OUT/NAME.

    ``again``: ids of jobs that have kept their input. They are run again, and the name of a result
    is the id.

    Raises CliError: there is nothing to send, no server, or (at the end) some sequences failed.
    """
    uploads = find_uploads(list(paths))
    done: list[NamedUpload] = []
    waiting: list[NamedUpload | KeptJob] = [KeptJob(job_id) for job_id in again]
    for upload in uploads:
        there = await asyncio.to_thread(_is_there, upload, out, form, query)
        (done if there else waiting).append(upload)
    if form != ResultFormat.MP4:
        _make_rooms([out / upload.name for upload in waiting])
    outcomes, seconds = [Outcome(upload.name, None, skipped=True) for upload in done], 0.0
    if waiting:
        if ray is not None:
            from vergence.cli.ray_batch import batch_on_ray

            named = [each for each in waiting if isinstance(each, NamedUpload)]
            sent, seconds = await asyncio.to_thread(batch_on_ray, ray, named, out, form, query)
        else:
            sent, seconds = await _send_to(server, waiting, out, form, query, console)
        outcomes += sent
    console.print(f"results    {out}")
    console.print(_table(outcomes, seconds))
    for each in outcomes:
        for note in dict.fromkeys([*each.job.warnings, *each.job.notes] if each.job else ()):
            console.print(f"[yellow]note[/]       {each.name}: {note}", soft_wrap=True)
        if each.job and query.get("keep_input"):
            console.print(f"kept       {each.name}: job {each.job.id}", soft_wrap=True)
    if json is not None:
        write_json(json, _figures(outcomes, seconds))
    failed = [outcome for outcome in outcomes if outcome.error]
    if failed:
        raise CliError(f"{len(failed)} of {len(outcomes)} sequences failed; the table says why")
    if unread := sum(outcome.job.frames_failed for outcome in outcomes if outcome.job):
        raise CliError(f"{unread} frames have no map; the results of all others are written")


def _is_there(upload: NamedUpload, out: Path, form: str, query: Query) -> bool:
    """Return whether a result of these bytes and options has been written before."""
    folder = out / upload.name
    return form != ResultFormat.MP4 and is_finished(folder, form, query, upload.upload.digest)


def _make_rooms(folders: Sequence[Path]) -> None:
    for folder in folders:
        try:
            make_room(folder)
        except OSError as error:
            raise CliError(f"{error}; or choose another one with --out", exit_code=2) from None


async def _send_to(
    server: str | None,
    uploads: Sequence[NamedUpload | KeptJob],
    out: Path,
    form: str,
    query: Query,
    console: Console,
) -> tuple[list[Outcome], float]:
    if server is not None:
        return await send_all(uploads, server, out, form, query, console)
    async with local_server(scheme="http", pixels=LARGEST_PIXELS) as address:
        return await send_all(uploads, address, out, form, query, console)


async def send_all(
    uploads: Sequence[NamedUpload | KeptJob],
    server: str,
    out: Path,
    form: str,
    query: Query,
    console: Console,
) -> tuple[list[Outcome], float]:
    """Make the results of uploads with one server; return their outcomes, and the seconds."""
    started_s = time.monotonic()
    with progress_bar(console) as progress:
        async with AsyncBatchClient(server) as client:
            places = asyncio.Semaphore(_AT_ONCE)

            async def one(upload: NamedUpload | KeptJob) -> Outcome:
                async with places:
                    bar = progress.add_task(upload.name, total=None, note="uploading")
                    job: AsyncBatchJob | None = None
                    try:
                        job = await _submit(client, upload, query)
                        await _fetch(job, form, out / upload.name, progress, bar)
                        if not query.get("keep_input"):
                            await job.delete()
                        return Outcome(upload.name, job.info)
                    except DepthError as error:
                        info = job.info if job else None
                        return Outcome(upload.name, info, f"{error.code}: {error}")
                    except (ConnectionLost, OSError) as error:
                        known = f"; its job is {job.id}" if job else ""
                        return Outcome(upload.name, None, f"{error}{known}")
                    finally:
                        progress.remove_task(bar)

            outcomes = await asyncio.gather(*map(one, uploads))
    return outcomes, time.monotonic() - started_s


async def _submit(
    client: AsyncBatchClient, each: NamedUpload | KeptJob, query: Query
) -> AsyncBatchJob:
    if isinstance(each, KeptJob):
        return await (await client.job(each.name)).rerun_with(query)
    return await client.send(each.upload, query)


async def _fetch(
    job: AsyncBatchJob, form: str, target: Path, progress: Progress, bar: TaskID
) -> None:
    """Wait until the job has ended, and write its result meanwhile."""

    async def show() -> None:
        async for info in job.watch():
            ahead = f"{info.ahead} before it" if info.ahead else info.state
            note = f"{info.fps:.1f} fps" if info.fps else ahead
            progress.update(bar, completed=info.frames_done, total=info.frames, note=note)

    showing = asyncio.create_task(show())
    try:
        if form == ResultFormat.MP4:
            await job.download(target.with_name(f"{target.name}.mp4"), form)
        else:
            await job.save_as(target, form)
    finally:
        showing.cancel()
        await asyncio.gather(showing, return_exceptions=True)
    if job.info.state is JobState.CANCELLED:
        raise SequenceNotDone("the job was cancelled; the frames before that are written")


def _frames(outcomes: Sequence[Outcome]) -> int:
    return sum(each.job.frames for each in outcomes if each.job and not each.error)


def _figures(outcomes: Sequence[Outcome], seconds: float) -> Mapping[str, Any]:
    frames = _frames(outcomes)
    return {
        "sequences": len(outcomes),
        "failed": sum(each.error is not None for each in outcomes),
        "frames": frames,
        "seconds": seconds,
        "fps": frames / seconds if seconds else None,
        "skipped": sum(each.skipped for each in outcomes),
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
    failed = any(each.error or each.skipped for each in outcomes)
    if failed:
        table.add_column("")
    for each in outcomes:
        job = each.job
        accuracy = (job.accuracy if job else None) or {}
        numbers = (job.fps if job else None, accuracy.get("epe_px"), accuracy.get("d1_pct"))
        table.add_row(
            each.name,
            str(job.frames) if job else "",
            *(f"{value:.2f}" if value and math.isfinite(value) else "" for value in numbers),
            *([each.error or ("was there" if each.skipped else "")] if failed else []),
        )
    return table
