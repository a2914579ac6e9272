"""The routes of /v1/sequences: submit a sequence, follow its job, download its result."""

import asyncio
from collections.abc import AsyncIterator
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import JSONResponse, StreamingResponse

from vergence_proto.errors import (
    BadShape,
    NotReady,
    SequenceNotDone,
    UnknownSequence,
)
from vergence_proto.jobs import JobState
from vergence_service.jobs.job import Job
from vergence_service.jobs.progress import JobStatus
from vergence_service.jobs.queue import JobOrder, JobQueue
from vergence_service.jobs.registry import JobRegistry
from vergence_service.process.threads import ThreadPool
from vergence_service.transports.callers import CALLER
from vergence_service.transports.http.errors import PROBLEM_RESPONSE
from vergence_service.transports.http.frame_routes import frame_routes
from vergence_service.transports.http.idempotency import KeysInUse, Submission, check_digest
from vergence_service.transports.http.pages import ListQuery
from vergence_service.transports.http.result_download import ResultDownloads
from vergence_service.transports.http.sequence_models import (
    OptionsQuery,
    ResultQuery,
    SequenceJob,
    SubmitQuery,
)
from vergence_service.transports.http.tus import tus_routes
from vergence_service.transports.http.uploads import (
    ANY_TYPE,
    ARCHIVE_TYPES,
    FORM_TYPE,
    UploadLimits,
    client_of,
    digest_of,
    receive_kept,
    receive_sequence,
    while_connected,
)

# Proxies close connections that are silent for longer than about this.
_SILENCE_S = 15.0

_FILE = {"type": "string", "format": "binary"}
_BINARY = {"schema": _FILE}
# A client that was generated takes the first type that it knows: bytes, and not text.
_ARCHIVE_OR_FILM = {"application/zip": _BINARY, "video/mp4": _BINARY, ANY_TYPE: _BINARY}
_UPLOAD: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "description": f"An archive, of one of the types {', '.join(ARCHIVE_TYPES)}; or a form",
        "content": {
            # Generators of clients know this type of bytes; the others are accepted too.
            ANY_TYPE: _BINARY,
            FORM_TYPE: {
                "schema": {
                    "type": "object",
                    "description": "either `archive` alone, or the other three",
                    "properties": {
                        "archive": _FILE,
                        "left": {"type": "array", "items": _FILE},
                        "right": {"type": "array", "items": _FILE},
                        "sequence": {"$ref": "#/components/schemas/SequenceForm"},
                    },
                },
            },
        },
    }
}
_RESULT: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "A zip with one file per frame and output; with format=mp4 a film",
        "content": _ARCHIVE_OR_FILM,
    },
    206: {"description": "The part that `Range` asks for", "content": _ARCHIVE_OR_FILM},
}
_ACCEPTED: dict[int | str, dict[str, Any]] = {
    202: {
        "model": SequenceJob,
        "description": "Accepted: a crash or restart of the server does not lose it",
    }
}


def sequence_routes(
    queue: JobQueue, *, model: str, limits: UploadLimits, stopping: asyncio.Event
) -> APIRouter:
    """Make the routes. ``stopping`` ends the answers that wait for a job while the server stops."""
    jobs, threads, keys = queue.jobs, queue.threads, KeysInUse()
    downloads = ResultDownloads(jobs, threads)
    router = APIRouter(tags=["sequences"], responses=PROBLEM_RESPONSE)

    @router.post(
        "/v1/sequences",
        operation_id="submit_sequence",
        status_code=202,
        responses={**_RESULT, **_ACCEPTED},
        openapi_extra=_UPLOAD,
        response_class=Response,
    )
    async def submit(request: Request, query: Annotated[SubmitQuery, Query()]) -> Response:
        """Upload a sequence: an archive in any layout that `vergence run` reads, or a form.

        `curl --data-binary @room.zip -H 'content-type: application/zip' HOST/v1/sequences`
        """
        if query.model not in (None, model):
            raise BadShape(f"expected {model}, the model of this server, got {query.model!r}")
        await queue.check_webhook(query.webhook)
        client, caller = client_of(request), CALLER.get()
        submission = Submission.of(request, caller)
        order = JobOrder(
            source=query.source,
            options=query.options(),
            upload=query.upload or "",
            input=query.input,
            priority=query.priority,
            keep_input=query.keep_input,
            webhook=query.webhook,
            name=query.name,
            labels=query.labels,
            key=submission.key,
            key_fingerprint=submission.fingerprint,
        )
        upload_bytes = int(request.headers.get("content-length", 0))
        with keys.taken(submission.key):
            if (earlier := jobs.keyed(submission.key)) is not None:
                await _check_repeated(request, submission, earlier, limits, threads)
                status = jobs.status(earlier.job_id)
            else:
                async with queue.upload_folder(
                    client, upload_bytes=upload_bytes, owner=caller
                ) as folder:
                    if query.input:
                        found = await threads.run(queue.inputs.find, query.input)
                        await threads.run((folder / "input").symlink_to, found)
                        digest = ""
                    elif query.upload is None:
                        digest = await receive_sequence(request, folder, limits, threads)
                    else:
                        kept = await threads.run(queue.uploads.get, query.upload, caller)
                        digest = await receive_kept(request, kept, folder, limits, threads)
                    check_digest(submission.body_sha256, digest)
                    async with while_connected(request):
                        status = await queue.accept(
                            folder, order, upload_sha256=digest, client=client, owner=caller
                        )
                    if query.upload is not None:
                        await threads.run(queue.uploads.delete, query.upload)
        job_id = status.job.job_id
        if query.wait:
            while not (status := jobs.status(job_id)).job.ended and not stopping.is_set():
                await _change(jobs, stopping)
            if status.job.state is JobState.FAILED:
                raise SequenceNotDone(
                    f"sequence {job_id} has failed: {status.job.reason}: {status.job.message}; "
                    "its result keeps the frames before"
                )
            if status.job.ended:
                return await downloads.answer(request, job_id, query.format)
        return JSONResponse(
            SequenceJob.of(status).model_dump(mode="json"),
            status_code=202,
            headers={"Location": f"/v1/sequences/{job_id}"},
        )

    @router.get(
        "/v1/sequences",
        operation_id="list_sequences",
        response_class=Response,
        responses={
            200: {
                "model": list[SequenceJob],
                "description": "A page. The header `Link` has the address of the next one, if any",
            }
        },
    )
    async def list_sequences(request: Request, query: Annotated[ListQuery, Query()]) -> Response:
        """List the caller's jobs, newest first; none if the server asks for no credential."""
        caller = CALLER.get()

        def wanted(job: Job) -> bool:
            # Callers without a credential share a name: the id of a job is its secret.
            return caller.proven and caller.owns(job.owner) and query.wants(job)

        found, below = jobs.page(wanted, size=query.page_size, below=query.below())
        headers = {}
        if below is not None:
            url = request.url.include_query_params(page_token=query.token(below))
            headers["Link"] = f'<{url.path}?{url.query}>; rel="next"'
        body = await threads.run(_list_json, found)
        return Response(body, media_type="application/json", headers=headers)

    @router.post("/v1/sequences/{job_id}/cancel", operation_id="cancel_sequence")
    async def cancel(job_id: str) -> SequenceJob:
        """Stop a job, and keep the frames that are done. An ended job stays as it is."""
        jobs.check_owner(job_id, CALLER.get())
        return SequenceJob.of(await queue.cancel(job_id))

    @router.post(
        "/v1/sequences/{job_id}/rerun",
        operation_id="rerun_sequence",
        status_code=202,
        responses=_ACCEPTED,
    )
    async def rerun(
        request: Request, response: Response, job_id: str, query: Annotated[OptionsQuery, Query()]
    ) -> SequenceJob:
        """Submit the input of a job again, with other options. It must have kept its input."""
        await queue.check_webhook(query.webhook)
        client, caller = client_of(request), CALLER.get()
        jobs.check_owner(job_id, caller)
        before, submission = jobs.get(job_id), Submission.of(request, caller)
        order = JobOrder(
            source=before.source,
            input=before.input,
            options=query.options(before.options),
            priority=query.priority,
            keep_input=query.keep_input,
            webhook=query.webhook,
            name=query.name or before.name,
            labels=query.labels or before.labels,
            key=submission.key,
            key_fingerprint=submission.fingerprint,
        )
        with keys.taken(submission.key):
            if (earlier := jobs.keyed(submission.key)) is not None:
                submission.check(earlier, None)
                status = jobs.status(earlier.job_id)
            else:
                async with queue.upload_folder(client, upload_bytes=0, owner=caller) as folder:
                    await queue.link_input(job_id, folder)
                    status = await queue.accept(
                        folder,
                        order,
                        upload_sha256=before.upload_sha256,
                        client=client,
                        owner=caller,
                    )
        response.headers["Location"] = f"/v1/sequences/{status.job.job_id}"
        return SequenceJob.of(status)

    @router.get("/v1/sequences/{job_id}", operation_id="get_sequence")
    async def get_sequence(job_id: str) -> SequenceJob:
        """Get the state and the progress of a job."""
        jobs.check_owner(job_id, CALLER.get())
        return SequenceJob.of(jobs.status(job_id))

    @router.get(
        "/v1/sequences/{job_id}/events",
        operation_id="follow_sequence",
        response_class=StreamingResponse,
        responses={
            200: {
                "description": "Server-sent events: `progress` with the job, until it ends",
                "content": {"text/event-stream": {"schema": {"type": "string"}}},
            }
        },
    )
    async def events(job_id: str) -> StreamingResponse:
        """Follow the progress of a job."""
        jobs.check_owner(job_id, CALLER.get())
        return StreamingResponse(
            _events(jobs, job_id, stopping),
            media_type="text/event-stream",
            headers={"Cache-Control": "no-store"},
        )

    @router.head(
        "/v1/sequences/{job_id}/result", operation_id="measure_result", response_class=Response
    )
    @router.get(
        "/v1/sequences/{job_id}/result",
        operation_id="get_result",
        response_class=StreamingResponse,
        responses=_RESULT,
    )
    async def result(
        request: Request, job_id: str, query: Annotated[ResultQuery, Query()]
    ) -> Response:
        """Download the result, or a part of it. It is encoded while it is sent."""
        jobs.check_owner(job_id, CALLER.get())
        return await downloads.answer(request, job_id, query.format)

    @router.delete("/v1/sequences/{job_id}", status_code=204, operation_id="delete_sequence")
    async def delete(job_id: str) -> None:
        """Cancel the job if it has not ended, and delete all its files."""
        jobs.check_owner(job_id, CALLER.get())
        await queue.delete(job_id)

    router.include_router(frame_routes(jobs, threads, stopping))
    router.include_router(tus_routes(queue, queue.uploads, limits))
    return router


def no_sequence_routes(why: str) -> APIRouter:
    """Make the routes that replace :func:`sequence_routes` if jobs cannot be kept on disk."""
    router = APIRouter(include_in_schema=False)

    @router.api_route("/v1/sequences{rest:path}", methods=["DELETE", "GET", "POST"])
    async def refuse(rest: str) -> None:
        raise NotReady(f"this server accepts no sequences: {why}")

    return router


def _list_json(found: list[JobStatus]) -> bytes:
    rows = (SequenceJob.of(status).model_dump_json() for status in found)
    return f"[{','.join(rows)}]".encode()


async def _check_repeated(
    request: Request,
    submission: Submission,
    earlier: Job,
    limits: UploadLimits,
    threads: ThreadPool,
) -> None:
    """Raise KeyReused unless the request is the one that ``earlier`` was submitted by."""
    submission.check(earlier, submission.body_sha256)
    if submission.body_sha256 is None and "upload" not in request.query_params:
        submission.check(earlier, await digest_of(request, limits, threads))


async def _events(jobs: JobRegistry, job_id: str, stopping: asyncio.Event) -> AsyncIterator[str]:
    loop = asyncio.get_running_loop()
    reported: JobStatus | None = None
    spoken_s = loop.time()
    while not stopping.is_set():
        try:
            status = jobs.status(job_id)
        except UnknownSequence:
            yield "event: deleted\ndata: {}\n\n"
            return
        if status != reported:
            reported, spoken_s = status, loop.time()
            yield f"event: progress\ndata: {SequenceJob.of(status).model_dump_json()}\n\n"
        elif loop.time() - spoken_s >= _SILENCE_S:
            spoken_s = loop.time()
            yield ": still here\n\n"
        if status.job.ended:
            return
        await _change(jobs, stopping)


async def _change(jobs: JobRegistry, stopping: asyncio.Event) -> None:
    """Wait for a change of the jobs, for the server's end, or for the time to break the silence."""
    waits = [
        asyncio.create_task(jobs.change(within_s=_SILENCE_S)),
        asyncio.create_task(stopping.wait()),
    ]
    try:
        await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for wait in waits:
            wait.cancel()
