"""A server's /v1/sequences, from the other side: it may be busy, or gone for a while."""

import asyncio
import time
import zipfile
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import httpx

from vergence.cli.errors import Trouble
from vergence_proto.errors import DepthError, error_from_wire
from vergence_proto.jobs import JobState

# A server that is restarted is back within this.
_PATIENCE_S = 60.0
_ASK_EVERY_S = 0.5
_CHUNK = 1 << 20
_UNAVAILABLE = {429, 503}

Query = dict[str, str | int | bool | list[str]]
Job = dict[str, Any]  # the JSON of SequenceJob


@dataclass(frozen=True, slots=True)
class SequenceService:
    """Requests that are worth repeating are repeated; what is refused is raised.

    Raises the class of :mod:`vergence_proto.errors` that the server names, and Trouble where it
    cannot be reached.
    """

    http: httpx.AsyncClient

    async def submit(self, archive: Path, query: Query) -> Job:
        """Upload an archive, waiting for a place in the queue for as long as it takes."""
        size = (await asyncio.to_thread(archive.stat)).st_size
        headers = {"Content-Type": "application/octet-stream", "Content-Length": str(size)}
        while True:
            answer = await self._patiently(
                lambda: self.http.post(
                    "/v1/sequences", params=query, content=_chunks(archive), headers=headers
                )
            )
            if answer.status_code not in _UNAVAILABLE or "Retry-After" not in answer.headers:
                break
            await asyncio.sleep(float(answer.headers["Retry-After"]))
        return _checked_json(answer)

    async def watch(self, job: Job) -> AsyncIterator[Job]:
        """The job, again and again, until it has ended."""
        while True:
            yield job
            if JobState(job["state"]).ended:
                return
            await asyncio.sleep(_ASK_EVERY_S)
            ask = partial(self.http.get, f"/v1/sequences/{job['id']}")
            job = _checked_json(await self._patiently(ask))

    async def fetch(self, job: Job, form: str, target: Path) -> None:
        """The result of a job: a folder of files, or a film."""
        target.parent.mkdir(parents=True, exist_ok=True)
        film = form == "mp4"
        file = target.with_name(target.name + (".mp4" if film else ".zip.part"))
        url = f"/v1/sequences/{job['id']}/result"

        async def download() -> httpx.Response:
            async with self.http.stream("GET", url, params={"format": form}) as answer:
                if answer.is_error:
                    await answer.aread()
                    return answer
                with file.open("wb") as sink:
                    async for chunk in answer.aiter_bytes(_CHUNK):
                        await asyncio.to_thread(sink.write, chunk)
            return answer

        answer = await self._patiently(download)
        if answer.is_error:
            raise _error_of(answer)
        if not film:
            await asyncio.to_thread(_unpack, file, target)

    async def forget(self, job: Job) -> None:
        """Free the room that the job takes on the server."""
        await self._patiently(lambda: self.http.delete(f"/v1/sequences/{job['id']}"))

    async def _patiently(self, ask: Callable[[], Awaitable[httpx.Response]]) -> httpx.Response:
        since_s = time.monotonic()
        while True:
            try:
                return await ask()
            except httpx.TransportError as error:
                if time.monotonic() - since_s > _PATIENCE_S:
                    raise Trouble(f"cannot reach {self.http.base_url}: {error}") from None
            await asyncio.sleep(_ASK_EVERY_S)


async def _chunks(path: Path) -> AsyncIterator[bytes]:
    with path.open("rb") as file:
        while chunk := await asyncio.to_thread(file.read, _CHUNK):
            yield chunk


def _checked_json(answer: httpx.Response) -> Job:
    if answer.is_error:
        raise _error_of(answer)
    job: Job = answer.json()
    return job


def _error_of(answer: httpx.Response) -> DepthError | Trouble:
    if answer.headers.get("Content-Type") == "application/problem+json":
        problem = answer.json()
        if "reason" in problem:
            return error_from_wire(problem["reason"], problem["detail"])
    return Trouble(f"{answer.url} answered {answer.status_code}: is it a Vergence server?")


def _unpack(archive: Path, folder: Path) -> None:
    with zipfile.ZipFile(archive) as file:
        file.extractall(folder)  # our own server's; extractall keeps names below the folder
    archive.unlink()
