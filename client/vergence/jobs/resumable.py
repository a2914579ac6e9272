"""Send an upload so that a lost connection costs only what was on its way (tus 1.0.0)."""

import asyncio

from vergence.jobs.packing import Upload
from vergence.jobs.requests import Requests
from vergence_proto.errors import UnknownSequence

_UPLOADS = "/v1/uploads"
_VERSION = {"Tus-Resumable": "1.0.0"}
_PART = {**_VERSION, "Content-Type": "application/offset+octet-stream"}


async def send_resumably(requests: Requests, upload: Upload) -> str:
    """Send an upload; return its id when all of it has arrived.

    Raises what the server answers, and ConnectionLost: it cannot be reached.
    """
    size = await asyncio.to_thread(upload.size)
    while True:
        announced = await requests.ask(
            "POST",
            _UPLOADS,
            headers={**_VERSION, "Upload-Length": str(size)},
            when_full=True,
        )
        path = announced.headers["Location"]
        try:
            await _send(requests, upload, path, size)
        except UnknownSequence:  # a server without its files took the place of the one before
            continue
        return str(path.rpartition("/")[2])


async def _send(requests: Requests, upload: Upload, path: str, size: int) -> None:
    async def send_rest() -> int:
        """Send what the server does not have; return where its upload ends."""
        state = await requests.ask("HEAD", path, headers=_VERSION)
        start = int(state.headers["Upload-Offset"])
        if start == size:
            return size
        answer = await requests.once(
            "PATCH",
            path,
            headers={
                **_PART,
                "Upload-Offset": str(start),
                "Content-Length": str(size - start),
            },
            body=upload.chunks(start),
        )
        return int(answer.headers["Upload-Offset"])

    while await requests.patiently(send_rest) < size:
        pass
