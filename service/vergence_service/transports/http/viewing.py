"""What the administrator's page shows of a stream: its newest image, disparity and sigma.

A view is small, so that a browser gets several a second: a JPEG and two planes of every n-th pixel.
It is ``uint32 HEADER_BYTES``, the header as JSON (:class:`ViewHeader`), the JPEG, then disparity
and sigma as ``uint16 [height, width]`` in 1/64 px, row by row; 0: no value. All little-endian.
"""

import asyncio
import dataclasses
import json
import struct
from dataclasses import dataclass

import cv2
import numpy as np
from fastapi import APIRouter, Response

from vergence_proto.codec.images import encode_jpeg
from vergence_proto.codec.planes import fixed_point
from vergence_proto.errors import Forbidden
from vergence_service.streams.conversion import SteppedFrame
from vergence_service.streams.engine import DepthEngine
from vergence_service.transports.http.errors import PROBLEM_RESPONSE

_MOST_COLUMNS = 480
_STEPS_PER_PX = 64
_JPEG_QUALITY = 80
# A browser asks again; a proxy may close what is silent for longer.
_WAIT_S = 10.0


@dataclass(frozen=True, slots=True)
class ViewHeader:
    """About a view. A point's depth in metres is ``fx * baseline_m / disparity``."""

    frame_id: int
    jpeg_bytes: int
    width: int
    height: int
    every: int  # n: of the rectified image, every n-th row and column was taken
    fx: float  # in pixels of the rectified image, as all below
    fy: float
    cx: float  # of the left camera
    cy: float
    baseline_m: float
    max_disparity_px: float
    origin: str  # why the step was warm or cold
    step_count: int  # warm steps since the last cold start


def viewing_routes(engine: DepthEngine, *, images: bool) -> APIRouter:
    """Make the route. Without ``images``, nobody sees what a camera saw."""
    router = APIRouter(responses=PROBLEM_RESPONSE)

    @router.get("/v1/admin/streams/{principal}/{stream_id}/view", response_class=Response)
    async def view(principal: str, stream_id: str) -> Response:
        """Wait for the next frame of a stream; 204 if none comes within ten seconds."""
        if not images:
            raise Forbidden("this server shows no images: its setting admin.images is false")
        stream = engine.streams.get(stream_id, owner=principal)
        try:
            async with asyncio.timeout(_WAIT_S):
                frame = await engine.viewers.next_frame(stream.key)
        except TimeoutError:
            return Response(status_code=204)
        body = await engine.threads.background.run(encode_view, frame)
        return Response(
            body, media_type="application/octet-stream", headers={"Cache-Control": "no-store"}
        )

    return router


def encode_view(frame: SteppedFrame) -> bytes:
    """Encode a view of a frame. Call it in a worker thread."""
    rectifier, answer = frame.stream.rectifier, frame.disparity_map()
    sigma_px = rectifier.sigma_px(frame.result.sigma_px)
    rig = answer.rig
    every = -(-rig.width // _MOST_COLUMNS)
    disparity = fixed_point(answer.disparity_px[::every, ::every], _STEPS_PER_PX)
    height, width = disparity.shape
    left = rectifier.window.left_of(frame.view.left, rig.height, rig.width)
    small = cv2.resize(left, (width, height), interpolation=cv2.INTER_AREA)
    jpeg = encode_jpeg(np.asarray(small, np.uint8), _JPEG_QUALITY)
    header = ViewHeader(
        frame_id=frame.frame_id,
        jpeg_bytes=len(jpeg),
        width=width,
        height=height,
        every=every,
        fx=rig.fx,
        fy=rig.fy,
        cx=rig.cx_left,
        cy=rig.cy,
        baseline_m=rig.baseline_m,
        max_disparity_px=answer.max_disparity_px,
        origin=frame.origin.name.lower(),
        step_count=answer.step_count,
    )
    text = json.dumps(dataclasses.asdict(header)).encode()
    sigma = fixed_point(sigma_px[::every, ::every], _STEPS_PER_PX)
    return struct.pack("<I", len(text)) + text + jpeg + disparity.tobytes() + sigma.tobytes()
