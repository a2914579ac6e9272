"""The frames of a job, one resource each, also while it runs."""

import asyncio
import zlib
from collections.abc import Iterator
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request, Response
from fastapi import Path as PathParameter
from pydantic import BaseModel, ConfigDict, Field

from vergence_proto.errors import BadShape, SequenceNotDone, UnknownSequence
from vergence_proto.job_results.folders import RESULT_LAYOUTS
from vergence_proto.job_results.folders.base import About
from vergence_proto.job_results.folders.maps import MapLayout
from vergence_proto.job_results.frame_file import MEDIA_TYPE, decode_frame
from vergence_proto.jobs import JobOutput, ResultFormat
from vergence_service.jobs.archive import manifest_of
from vergence_service.jobs.progress import JobStatus
from vergence_service.jobs.registry import JobRegistry
from vergence_service.jobs.results import frame_path, read_made, read_records
from vergence_service.process.threads import ThreadPool
from vergence_service.transports.callers import CALLER
from vergence_service.transports.http.errors import PROBLEM_RESPONSE
from vergence_service.transports.http.ranges import ranged
from vergence_service.transports.http.uploads import ANY_TYPE

NDJSON = "application/x-ndjson"
_MAP_FORMATS = {
    "png": ResultFormat.PNG16,
    "mm.png": ResultFormat.PNG16MM,
    "pfm": ResultFormat.PFM,
}
_MEDIA_TYPES = {"png": "image/png", "jpg": "image/jpeg", "webp": "image/webp"}
# A frame never changes, unless its job begins again with another model: then its tag does.
_CACHED = "private, no-cache"


class FrameFile(StrEnum):
    """One file of one frame."""

    DISPARITY_PNG = "disparity.png"
    DISPARITY_PFM = "disparity.pfm"
    DEPTH_PNG = "depth.png"
    DEPTH_MM_PNG = "depth.mm.png"
    DEPTH_PFM = "depth.pfm"
    CONFIDENCE_PNG = "confidence.png"
    SIGMA_PNG = "sigma.png"
    SIGMA_PFM = "sigma.pfm"
    LEFT = "left"
    POINTS = "points.ply"


class FramesQuery(BaseModel):
    model_config = ConfigDict(extra="forbid")

    after: int = Field(
        default=-1, ge=-1, le=1 << 40, description="only frames with a larger index than this"
    )
    limit: int = Field(default=1000, ge=1, le=10_000, description="most lines of the answer")
    wait_s: float = Field(
        default=0.0, ge=0, le=30, description="time to wait for a frame that is not done yet"
    )


_Index = Annotated[int, PathParameter(ge=0, le=1 << 40, description="index of the frame, from 0")]
_BYTES = {"schema": {"type": "string", "format": "binary"}}


def frame_routes(jobs: JobRegistry, threads: ThreadPool, stopping: asyncio.Event) -> APIRouter:
    """Make the routes. ``stopping`` ends the answers that wait while the server stops."""

    def check_owner(job_id: str) -> None:
        jobs.check_owner(job_id, CALLER.get())

    router = APIRouter(
        tags=["sequences"], responses=PROBLEM_RESPONSE, dependencies=[Depends(check_owner)]
    )

    @router.get("/v1/sequences/{job_id}/manifest", operation_id="get_manifest")
    async def manifest(job_id: str) -> dict[str, Any]:
        """Get what is known about a job: model, options, rig, units, counts."""
        status, folder = jobs.frames_of(job_id)
        try:
            return await threads.run(manifest_of, status, folder)
        except FileNotFoundError:
            raise SequenceNotDone(
                f"sequence {job_id} has no frames yet, it is {status.job.state}",
                retry_after_s=None if status.job.ended else 1.0,
            ) from None

    @router.get(
        "/v1/sequences/{job_id}/frames",
        operation_id="list_frames",
        response_class=Response,
        responses={
            200: {
                "description": "One line of JSON per frame, in order, as in frames.jsonl; none: no "
                "frame was done in time. `Vergence-Ended: true` says that no other will follow.",
                "content": {NDJSON: {"schema": {"type": "string"}}, ANY_TYPE: _BYTES},
            }
        },
    )
    async def frames(job_id: str, query: Annotated[FramesQuery, Query()]) -> Response:
        """List the frames that are done, also while the job runs; waits for the next one."""
        loop = asyncio.get_running_loop()
        until_s = loop.time() + query.wait_s
        while True:
            status, folder = jobs.frames_of(job_id)
            ready = status.frames_done > query.after + 1
            left_s = until_s - loop.time()
            if ready or status.job.ended or left_s <= 0 or stopping.is_set():
                break
            await jobs.change(within_s=left_s)
        start = query.after + 1
        count = min(status.frames_done - start, query.limit)
        body = b""
        if count > 0:
            body = await threads.run(_lines, folder, start, count)
        ended = status.job.ended and start + max(count, 0) >= status.frames_done
        headers = {"Vergence-Ended": str(ended).lower(), "Cache-Control": "no-store"}
        return Response(body, media_type=NDJSON, headers=headers)

    @router.get(
        "/v1/sequences/{job_id}/frames/{index}",
        operation_id="get_frame",
        response_class=Response,
        responses={
            200: {
                "description": "A line of JSON, then a DisparityMap of depth.proto and the left "
                "image, if the job kept it; see vergence_proto/job_results/frame_file.py",
                "content": {MEDIA_TYPE: _BYTES, ANY_TYPE: _BYTES},
            },
            304: {"description": "The frame is the one that If-None-Match names"},
        },
    )
    async def frame(request: Request, job_id: str, index: _Index) -> Response:
        """Get all that is kept of a frame, in 1/64 px."""
        status, folder = jobs.frames_of(job_id)
        data = await _content(threads, status, folder, index)
        return _tagged(request, data, zlib.crc32(data), MEDIA_TYPE)

    @router.get(
        "/v1/sequences/{job_id}/frames/{index}/{file}",
        operation_id="get_frame_file",
        response_class=Response,
        responses={
            200: {
                "description": "A file, as in the archives",
                "content": {
                    **dict.fromkeys(_MEDIA_TYPES.values(), _BYTES),
                    ANY_TYPE: _BYTES,
                },
            },
            304: {"description": "The file is the one that If-None-Match names"},
        },
    )
    async def frame_file(request: Request, job_id: str, index: _Index, file: FrameFile) -> Response:
        """Get one map, the left image or the points of a frame."""
        status, folder = jobs.frames_of(job_id)
        data = await _content(threads, status, folder, index)
        name, content = await threads.run(_file_of, data, folder, file, status)
        suffix = name.rpartition(".")[2]
        media_type = _MEDIA_TYPES.get(suffix, ANY_TYPE)
        return _tagged(request, content, zlib.crc32(data), media_type)

    return router


def _lines(folder: Path, start: int, count: int) -> bytes:
    lines = (record.to_json() for record in read_records(folder, start, count))
    return "".join(f"{line}\n" for line in lines).encode()


async def _content(threads: ThreadPool, status: JobStatus, folder: Path, index: int) -> bytes:
    job = status.job
    if index >= job.frames:
        raise UnknownSequence(f"sequence {job.job_id} has {job.frames} frames, no frame {index}")
    if index < status.frames_done:
        try:
            return await threads.run(frame_path(folder, index).read_bytes)
        except FileNotFoundError:
            pass  # it was deleted a moment ago, or begins again
    raise SequenceNotDone(
        f"frame {index} of sequence {job.job_id} is not done: {status.frames_done} of "
        f"{job.frames} are, and it is {job.state}",
        retry_after_s=None if job.ended else 1.0,
    )


def _file_of(data: bytes, folder: Path, file: FrameFile, status: JobStatus) -> tuple[str, bytes]:
    kind, _, suffix = file.value.partition(".")
    output, options = JobOutput(kind), status.job.options
    available = {*options.outputs, JobOutput.DISPARITY, JobOutput.DEPTH}
    if output not in available:
        raise BadShape(
            f"the job did not keep {kind}; it kept {', '.join(sorted(available))}; submit it "
            f"again with output={kind}"
        )
    rig = read_made(folder).rig
    frame = decode_frame(data, rig)
    if frame.disparity is None:
        raise UnknownSequence(f"frame {frame.record.index} has no map: {frame.record.error}")
    layout = RESULT_LAYOUTS[_MAP_FORMATS.get(suffix, ResultFormat.PNG16)](
        About(manifest={}, rig=rig, outputs=[output])
    )
    assert isinstance(layout, MapLayout)
    files: Iterator[tuple[str, bytes]] = iter(layout.frame(frame))
    return next(files)


def _tagged(request: Request, content: bytes, tag: int, media_type: str) -> Response:
    return ranged(request, content, f'"{tag:08x}"', media_type, {"Cache-Control": _CACHED})
