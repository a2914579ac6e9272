"""The client of a server's jobs, for asyncio."""

import asyncio
from collections.abc import AsyncIterator, Iterable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Literal, Self

from vergence.errors import NotOpen
from vergence.jobs.info import JobInfo
from vergence.jobs.job import SEQUENCES, AsyncBatchJob, Output, Priority, new_key
from vergence.jobs.packing import Upload, upload_of
from vergence.jobs.requests import Query, Requests
from vergence.jobs.resumable import send_resumably
from vergence.transports.addresses import is_private
from vergence.transports.credentials import Credentials
from vergence_proto.geometry import RectifiedRig
from vergence_proto.jobs import JobState

DEFAULT_SERVER = "http://127.0.0.1:8000"

Source = str | Path | Iterable[tuple[Any, ...]]


class AsyncBatchClient:
    """Submits whole sequences to a server, and reads their results; use it inside ``async with``.

    Every method goes on after lost connections and restarts of the server.

    Parameters
    ----------
    server
        ``http://HOST:PORT`` or ``https://HOST:PORT``.
    token, ca, cert, key
        Credentials, as those of :class:`vergence.DepthClient`.
    patience_s
        Give up when no byte has come or gone for this long.

    Raises
    ------
    ValueError
        A credential cannot be used.
    ImportError
        httpx is not installed; it is part of ``vergence[cli]``.
    """

    def __init__(
        self,
        server: str = DEFAULT_SERVER,
        *,
        token: str | None = None,
        ca: str | Path | None = None,
        cert: str | Path | None = None,
        key: str | Path | None = None,
        patience_s: float = 60.0,
    ) -> None:
        address = server if "://" in server else f"http://{server}"
        private = is_private(address)
        self._address = address
        self._credentials = Credentials.of(token, ca, cert, key, private=private)
        self._patience_s = patience_s
        self._open: Requests | None = None

    async def __aenter__(self) -> Self:
        """Open the client."""
        self._open = Requests(self._address, self._credentials, patience_s=self._patience_s)
        await self._open.__aenter__()
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        """Close the client; its jobs go on."""
        requests, self._open = self._open, None
        if requests is not None:
            await requests.__aexit__(*exc_info)

    async def submit(
        self,
        source: Source,
        *,
        outputs: Sequence[Output] = ("disparity",),
        name: str = "",
        labels: Mapping[str, str] | None = None,
        on_error: Literal["skip", "fail"] = "skip",
        iterations: int = 0,
        quality: Literal["fast", "steady", "best"] = "fast",
        metrics: bool = False,
        priority: Priority = "normal",
        keep_input: bool = False,
        webhook: str = "",
        rig: RectifiedRig | None = None,
        fps: float = 30.0,
    ) -> AsyncBatchJob:
        """Upload a sequence; return its job when the server has accepted it.

        It waits while the server has no room. A lost connection does not submit it twice.

        Parameters
        ----------
        source
            A folder, an archive, ``KIND:PATH`` of a data set, or pairs of arrays: ``(left, right)``
            or ``(left, right, world_from_left)``, uint8 [H, W] or [H, W, 3] RGB.
        outputs
            What to keep of every frame.
        name, labels
            Your own name and labels for the job.
        on_error
            "skip": a frame that cannot be read or stepped only costs itself; "fail": it ends the
            job, which keeps the frames before.
        iterations
            Refinement iterations of a single pair; 0: the server's default.
        quality
            "steady": a second pass backward in time for less flicker, at twice the time; "best":
            also a closer look at every frame, for fewer errors at six times the time. Both need
            poses.
        metrics
            Compare with the ground truth of the sequence.
        priority
            Which of the waiting jobs is next.
        keep_input
            Keep the sequence on the server as long as the result, for :meth:`AsyncBatchJob.rerun`.
        webhook
            The address that hears of the end of the job, if the server allows its host.
        rig, fps
            The rectified rig and the frame rate of arrays.

        Raises
        ------
        BadSequence, BadCalibration, BadShape, FrameTooLarge, UploadTooLarge
            The server cannot use the sequence, or the source is none.
        InsufficientStorage
            The disk of the server has no room.
        ConnectionLost
            The server cannot be reached.
        """
        query = {
            "output": list(outputs),
            "name": name,
            "label": [f"{key}:{value}" for key, value in (labels or {}).items()],
            "on_error": on_error,
            "iterations": iterations,
            "quality": quality,
            "metrics": metrics,
            "priority": priority,
            "keep_input": keep_input,
            "webhook": webhook,
        }
        with ExitStack() as stack:
            upload = await asyncio.to_thread(_upload_of, source, stack, rig, fps)
            return await self.send(upload, query)

    async def send(self, upload: Upload, query: Query) -> AsyncBatchJob:
        """Upload what was found before, with the options of the HTTP API."""
        upload_id = await send_resumably(self._requests, upload)
        source = {} if upload.source is None else {"source": upload.source}
        answer = await self._requests.ask(
            "POST",
            SEQUENCES,
            query={**query, **source, "upload": upload_id},
            headers=new_key(),
            when_full=True,
            unpacking=True,
        )
        return AsyncBatchJob(self._requests, JobInfo.from_json(answer.json()))

    async def job(self, job_id: str) -> AsyncBatchJob:
        """Return a job that was submitted before, here or elsewhere. Raises UnknownSequence."""
        answer = await self._requests.ask("GET", f"{SEQUENCES}/{job_id}")
        return AsyncBatchJob(self._requests, JobInfo.from_json(answer.json()))

    async def jobs(
        self, *, state: JobState | None = None, labels: Mapping[str, str] | None = None
    ) -> AsyncIterator[JobInfo]:
        """Yield your jobs, newest first. Servers without tokens list none."""
        filters = [f"{key}:{value}" for key, value in (labels or {}).items()]
        query: dict[str, Any] = {"label": filters, **({"state": state} if state else {})}
        url: str | None = SEQUENCES
        while url is not None:
            answer = await self._requests.ask("GET", url, query=query)
            for values in answer.json():
                yield JobInfo.from_json(values)
            url, query = answer.links.get("next", {}).get("url"), {}

    @property
    def _requests(self) -> Requests:
        if self._open is None:
            raise NotOpen("the client is not open; write: async with AsyncBatchClient() as client")
        return self._open


def _upload_of(source: Any, stack: ExitStack, rig: RectifiedRig | None, fps: float) -> Upload:
    return upload_of(source, stack, rig=rig, fps=fps)
