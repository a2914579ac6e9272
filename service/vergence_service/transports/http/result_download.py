"""The download of a result: it is encoded while it is sent, and continues after a cut."""

import asyncio
import http
from collections.abc import AsyncGenerator, AsyncIterator, Iterator
from contextlib import aclosing
from pathlib import Path
from weakref import WeakValueDictionary

from fastapi import Request, Response
from fastapi.responses import StreamingResponse

from vergence_proto.errors import BadShape
from vergence_proto.jobs import ResultFormat
from vergence_service.jobs.archive import CannotEncode, read_pieces, write_film
from vergence_service.jobs.archive_index import archive_tag, part_of, read_index, recording
from vergence_service.jobs.job import Job
from vergence_service.jobs.registry import JobRegistry
from vergence_service.process.threads import ThreadPool
from vergence_service.transports.http.ranges import Part, has_already, part_for, wants_part

_NO_CACHE = "private, no-cache"


class ResultDownloads:
    """Answers requests for results."""

    def __init__(self, jobs: JobRegistry, threads: ThreadPool) -> None:
        self._jobs = jobs
        self._threads = threads
        # One request at a time measures an archive; the others find its index.
        self._turns: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()

    async def answer(self, request: Request, job_id: str, form: ResultFormat) -> Response:
        """Answer with an archive or a film, a part of it, or what HEAD asks for.

        Raises UnknownSequence, SequenceNotDone, and BadShape if the job has not kept what the
        format needs.
        """
        job, folder = self._jobs.result(job_id)
        tag = archive_tag(job, form)
        headers = {"ETag": f'"{tag}"', "Accept-Ranges": "bytes", "Cache-Control": _NO_CACHE}
        if has_already(request, headers["ETag"]):
            return Response(status_code=http.HTTPStatus.NOT_MODIFIED, headers=headers)
        film = form is ResultFormat.MP4
        name = f"{job_id}-{job.source.partition(':')[0]}.{'mp4' if film else 'zip'}"
        headers["Content-Disposition"] = f'attachment; filename="{name}"'
        kept = folder.parent / "archives" / tag
        turn = self._turns.setdefault(tag, asyncio.Lock())
        with self._jobs.reading(job_id):
            if film:
                return await self._film(request, job, folder, kept.with_suffix(".mp4"), headers)
            index = await self._threads.run(read_index, kept)
            if index is None and (request.method == "HEAD" or wants_part(request, headers["ETag"])):
                async with turn:
                    index = await self._threads.run(read_index, kept)
                    if index is None:
                        made = await self._recording(job, folder, form, kept)
                        await self._threads.finish(made)
                        index = await self._threads.run(read_index, kept)
            if index is None:
                return await self._streamed(
                    job, await self._recording(job, folder, form, kept), headers, None
                )
            part = part_for(request, index.total, headers["ETag"])
            pieces = await self._threads.run(
                part_of, self._jobs.status(job_id), folder, form, index, part.start, part.stop
            )
            return await self._streamed(job, pieces, headers, part, head=request.method == "HEAD")

    async def _recording(
        self, job: Job, folder: Path, form: ResultFormat, kept: Path
    ) -> Iterator[bytes]:
        return await self._threads.run(recording, self._jobs.status(job.job_id), folder, form, kept)

    async def _film(
        self, request: Request, job: Job, folder: Path, path: Path, headers: dict[str, str]
    ) -> Response:
        if not await self._threads.run(path.is_file):
            try:
                await self._threads.finish(write_film(job, folder, path))
            except CannotEncode as error:
                raise BadShape(f"format {ResultFormat.MP4}: {error}") from None
        size = (await self._threads.run(path.stat)).st_size
        part = part_for(request, size, headers["ETag"])
        pieces = read_pieces(path, part.start, part.stop)
        return await self._streamed(
            job, pieces, headers, part, head=request.method == "HEAD", media_type="video/mp4"
        )

    async def _streamed(
        self,
        job: Job,
        pieces: Iterator[bytes],
        headers: dict[str, str],
        part: Part | None,
        *,
        head: bool = False,
        media_type: str = "application/zip",
    ) -> Response:
        if part is not None:
            headers = {**headers, **part.headers}
        status = http.HTTPStatus.OK if part is None else part.status
        if head:
            return Response(status_code=status, headers=headers, media_type=media_type)
        body = self._pieces(job.job_id, pieces)
        # An error of the first frame must come before the answer begins.
        first = await anext(body, b"")
        return StreamingResponse(_chained(first, body), status, headers, media_type)

    async def _pieces(self, job_id: str, pieces: Iterator[bytes]) -> AsyncGenerator[bytes, None]:
        async with aclosing(self._threads.iterate(pieces)) as taken:
            with self._jobs.reading(job_id):
                async for piece in taken:
                    yield piece


async def _chained(first: bytes, rest: AsyncGenerator[bytes, None]) -> AsyncIterator[bytes]:
    async with aclosing(rest):
        yield first
        async for piece in rest:
            yield piece
