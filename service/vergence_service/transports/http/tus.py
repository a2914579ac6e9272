"""Uploads that can be resumed: the protocol tus 1.0.0 (https://tus.io/protocols/resumable-upload).

Its extensions ``creation``, ``termination`` and ``expiration`` are there. A complete upload becomes
a job by ``POST /v1/sequences?upload=ID``.
"""

import asyncio
from email.utils import formatdate
from typing import Annotated

from fastapi import APIRouter, Header, Request, Response
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from vergence_proto.errors import BadShape, UploadTooLarge
from vergence_service.jobs.kept_uploads import KeptUpload, KeptUploads
from vergence_service.jobs.queue import JobQueue
from vergence_service.transports.callers import CALLER
from vergence_service.transports.http.bodies import body_of
from vergence_service.transports.http.errors import PROBLEM_RESPONSE
from vergence_service.transports.http.uploads import UploadLimits

_VERSION = "1.0.0"
_PART = "application/offset+octet-stream"
_BYTES = {"schema": {"type": "string", "format": "binary"}}
_Length = Annotated[int, Header(ge=1, le=1 << 50, description="bytes of the whole upload")]
_Offset = Annotated[int, Header(ge=0, le=1 << 50, description="bytes that are there")]
_Resumable = Annotated[str, Header(description="version of the protocol: 1.0.0")]


def tus_routes(queue: JobQueue, uploads: KeptUploads, limits: UploadLimits) -> APIRouter:
    """Make the routes."""
    threads = queue.threads
    router = APIRouter(tags=["uploads"], responses=PROBLEM_RESPONSE)
    receiving: dict[str, asyncio.Task[None]] = {}

    async def found(upload_id: str) -> KeptUpload:
        return await threads.run(uploads.get, upload_id, CALLER.get())

    async def take_over(upload_id: str) -> None:
        """End the request that adds to an upload: its client is gone and begins again."""
        task = receiving.get(upload_id)
        if task is not None:
            task.cancel()
            await asyncio.wait([task])

    @router.options(
        "/v1/uploads", status_code=204, operation_id="describe_uploads", response_class=Response
    )
    async def describe() -> Response:
        """Say which parts of the protocol this server has."""
        return _answer(
            204,
            {
                "Tus-Version": _VERSION,
                "Tus-Extension": "creation,termination,expiration",
                "Tus-Max-Size": str(limits.max_bytes),
            },
        )

    @router.post(
        "/v1/uploads", status_code=201, operation_id="create_upload", response_class=Response
    )
    async def create(upload_length: _Length, tus_resumable: _Resumable = _VERSION) -> Response:
        """Announce an upload; the answer's Location is where its bytes go."""
        _check_version(tus_resumable)
        if upload_length > limits.max_bytes:
            raise UploadTooLarge(
                f"expected an upload of at most {limits.max_bytes} bytes; the server's setting "
                f"{limits.max_bytes_setting} allows more"
            )
        await queue.room.check_upload(upload_length, CALLER.get())
        upload = await threads.run(uploads.create, CALLER.get(), upload_length)
        return _answer(201, {"Location": f"/v1/uploads/{upload.upload_id}", **_state(upload)})

    @router.head("/v1/uploads/{upload_id}", operation_id="get_upload", response_class=Response)
    async def state(upload_id: str) -> Response:
        """Get how much of an upload is there."""
        await found(upload_id)
        await take_over(upload_id)
        return _answer(200, _state(await found(upload_id)))

    @router.patch(
        "/v1/uploads/{upload_id}",
        status_code=204,
        operation_id="continue_upload",
        response_class=Response,
        openapi_extra={"requestBody": {"required": True, "content": {_PART: _BYTES}}},
    )
    async def extend(
        request: Request,
        upload_id: str,
        upload_offset: _Offset,
        tus_resumable: _Resumable = _VERSION,
    ) -> Response:
        """Add bytes to an upload. What arrives stays, also if the connection breaks."""
        _check_version(tus_resumable)
        if request.headers.get("content-type", "").partition(";")[0] != _PART:
            raise HTTPException(415, f"expected a body of {_PART}")
        await found(upload_id)
        await take_over(upload_id)
        upload = await found(upload_id)
        if upload_offset != upload.offset:
            raise HTTPException(
                409,
                f"expected Upload-Offset {upload.offset}, where the upload ends, got "
                f"{upload_offset}",
            )
        task = receiving[upload_id] = asyncio.create_task(_append(request, upload, queue, limits))
        try:
            await asyncio.wait([task])
        finally:
            task.cancel()
            if receiving.get(upload_id) is task:
                del receiving[upload_id]
        if task.cancelled():
            raise HTTPException(409, "another request continues this upload")
        task.result()
        return _answer(204, _state(await found(upload_id)))

    @router.delete(
        "/v1/uploads/{upload_id}",
        status_code=204,
        operation_id="delete_upload",
        response_class=Response,
    )
    async def delete(upload_id: str) -> Response:
        """Delete an upload and its bytes."""
        await found(upload_id)
        await take_over(upload_id)
        await threads.run(uploads.delete, upload_id)
        return _answer(204, {})

    return router


async def _append(
    request: Request, upload: KeptUpload, queue: JobQueue, limits: UploadLimits
) -> None:
    left = upload.length - upload.offset
    chunks = body_of(request, patience_s=limits.idle_s, min_bytes_per_s=limits.min_bytes_per_s)
    with await queue.threads.run(upload.path.open, "ab", 0) as file:
        try:
            async for chunk in chunks:
                left -= len(chunk)
                if left < 0:
                    raise BadShape(f"the body is longer than Upload-Length, {upload.length}")
                await queue.threads.run(file.write, chunk)
        except ClientDisconnect:
            pass  # it will ask how much has arrived


def _check_version(version: str) -> None:
    if version != _VERSION:
        raise HTTPException(412, f"expected Tus-Resumable: {_VERSION}", {"Tus-Version": _VERSION})


def _state(upload: KeptUpload) -> dict[str, str]:
    return {
        "Upload-Offset": str(upload.offset),
        "Upload-Length": str(upload.length),
        "Upload-Expires": formatdate(upload.expires_s, usegmt=True),
        "Cache-Control": "no-store",
    }


def _answer(status: int, headers: dict[str, str]) -> Response:
    return Response(status_code=status, headers={"Tus-Resumable": _VERSION, **headers})
