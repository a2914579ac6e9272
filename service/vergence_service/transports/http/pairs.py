"""The route of /v1/pairs: upload two images, download disparity. curl is enough."""

import io
import tempfile
from collections.abc import Callable, Mapping
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Query, Request, Response
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from vergence_proto.datasets import DatasetError, beyond_png, encode_disparity_png, read_image
from vergence_proto.errors import BadCalibration, BadImage, BadShape, FrameTooLarge
from vergence_proto.geometry import RectifiedRig
from vergence_proto.result_files import (
    beyond_mm_png,
    encode_confidence_png,
    encode_depth_mm_png,
    encode_sigma_png,
)
from vergence_proto.types import (
    Delivery,
    DisparityMap,
    Image,
    OutputFormat,
    StereoFrame,
    StereoRig,
)
from vergence_service.jobs.places import Places
from vergence_service.jobs.upload_checks import check_file
from vergence_service.process.threads import ThreadPool
from vergence_service.streams.engine import DepthEngine
from vergence_service.streams.stream import StreamConfig
from vergence_service.transports.callers import CALLER
from vergence_service.transports.http.errors import PROBLEM_RESPONSE
from vergence_service.transports.http.uploads import (
    FORM_TYPE,
    UploadLimits,
    media_type,
    receive_form,
    while_connected,
)


class PairFormat(StrEnum):
    """The file format of the answer."""

    PNG16 = "png16"  # value times 256, 0 where there is no value (the KITTI convention)
    PNG16MM = "png16mm"  # depth in millimetres, 0 where there is no value
    NPY = "npy"  # float32, NaN where there is no value
    NPZ = "npz"  # every map, by its name


class PairOutput(StrEnum):
    """The kind of map in the answer."""

    DISPARITY = "disparity"
    DEPTH = "depth"
    CONFIDENCE = "confidence"
    SIGMA = "sigma"


class PairQuery(BaseModel):
    """The options of a request."""

    model_config = ConfigDict(extra="forbid")

    format: PairFormat = PairFormat.PNG16
    output: PairOutput = Field(
        default=PairOutput.DISPARITY,
        description="depth is in metres and needs fx_px and baseline_m; confidence is the "
        "probability of an error below 1 px, times 255, 0 where there is no value; sigma is the "
        "expected error in pixels",
    )
    iterations: int = Field(default=0, ge=0, le=64, description="0: as many as a cold start")
    fx_px: float | None = Field(default=None, ge=1, le=1e6)
    baseline_m: float | None = Field(default=None, ge=1e-4, le=1e3)


RANGE_HEADER = "Vergence-Max-Disparity-Px"
BEYOND_HEADER = "Vergence-Beyond-Png"
_FILE = {"type": "string", "format": "binary"}
_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            FORM_TYPE: {
                "schema": {
                    "type": "object",
                    "required": ["left", "right"],
                    "additionalProperties": False,
                    "properties": {"left": _FILE, "right": _FILE},
                }
            }
        },
    }
}
_ANSWER: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "16-bit PNG (value times 256, 0: no value) or float32 NPY (NaN: no value); "
        "confidence: 8-bit PNG or uint8 NPY; png16mm: depth in millimetres; npz: every map",
        "headers": {
            RANGE_HEADER: {
                "description": "range of the search in pixels; nearer surfaces have no value",
                "schema": {"type": "number"},
            },
            BEYOND_HEADER: {
                "description": "pixels whose disparity or depth a 16-bit PNG cannot hold; they "
                "have no value in it, and their value in NPY",
                "schema": {"type": "integer"},
            },
        },
        "content": {"image/png": {"schema": _FILE}, "application/octet-stream": {"schema": _FILE}},
    }
}


def pair_routes(engine: DepthEngine, places: Places, *, limits: UploadLimits) -> APIRouter:
    """Make the route. Pairs that are uploaded take one of the ``places``."""
    router = APIRouter(tags=["pairs"], responses=PROBLEM_RESPONSE)

    @router.post("/v1/pairs", response_class=Response, responses=_ANSWER, openapi_extra=_BODY)
    async def step_pair(request: Request, query: Annotated[PairQuery, Query()]) -> Response:
        """Compute the disparity of one rectified pair, without a stream.

        `curl -F left=@left.png -F right=@right.png HOST/v1/pairs -o disparity.png`
        """
        places.check(CALLER.get())  # before the upload, which would be for nothing
        with tempfile.TemporaryDirectory() as scratch:
            files = await _upload(request, Path(scratch), limits, engine.threads.background)
            async with while_connected(request), places.taken(CALLER.get()):
                return await stepped(files, query)

    async def stepped(files: Mapping[str, Path], query: PairQuery) -> Response:
        background = engine.threads.background
        left, right = await background.run(_images, files, max_pixels=engine.max_pixels)
        height, width = left.shape[:2]
        nominal_px = float(width)  # any focal length gives the same disparity
        rig = RectifiedRig(
            width=width,
            height=height,
            fx=query.fx_px or nominal_px,
            fy=query.fx_px or nominal_px,
            cx_left=(width - 1) / 2,
            cx_right=(width - 1) / 2,
            cy=(height - 1) / 2,
            baseline_m=query.baseline_m or 1.0,
        )
        metric = bool(query.fx_px and query.baseline_m)
        if query.output is PairOutput.DEPTH and not metric:
            raise BadCalibration(
                "depth needs fx_px and baseline_m; without them, ask for disparity"
            )
        if query.format is PairFormat.PNG16MM and query.output is not PairOutput.DEPTH:
            raise BadShape("png16mm is for depth: add output=depth, or ask for png16")
        config = StreamConfig(
            StereoRig.from_rectified(rig),
            delivery=Delivery.EVERY,
            output=OutputFormat(confidence=True, sigma=True),
            cold_iterations=query.iterations,
        )
        frame = StereoFrame(1, 0, left, right)
        async with engine.offline(config, owner=CALLER.get().name) as stream:
            disparity = await engine.step_offline(stream, frame)
        return await background.run(_answer, disparity, query, metric=metric)

    return router


async def _upload(
    request: Request, folder: Path, limits: UploadLimits, threads: ThreadPool
) -> Mapping[str, Path]:
    if media_type(request) != FORM_TYPE:
        raise BadImage(f"expected a body of {FORM_TYPE} with the files left and right")
    parts = await receive_form(request, folder, limits, threads)
    if sorted(part.name for part in parts) != ["left", "right"]:
        names = sorted(part.name[:40] for part in parts)
        raise BadImage(f"expected one file left and one file right, got {names}")
    return {part.name: part.path for part in parts}


def _images(files: Mapping[str, Path], *, max_pixels: int) -> tuple[Image, Image]:
    left, right = (_image(files[name], name, max_pixels) for name in ("left", "right"))
    if left.shape != right.shape:
        raise BadShape(
            f"expected two images of one size, got left {left.shape[1]}x{left.shape[0]} and right "
            f"{right.shape[1]}x{right.shape[0]}"
        )
    return left, right


def _image(path: Path, name: str, max_pixels: int) -> Image:
    try:
        check_file(path, max_pixels=max_pixels)
        return read_image(path)
    except FrameTooLarge as error:
        raise FrameTooLarge(f"{name} image: {error}") from None
    except (BadImage, DatasetError) as error:
        raise BadImage(f"{name} image: {str(error).removeprefix(f'{path}: ')}") from None


def _answer(disparity: DisparityMap, query: PairQuery, *, metric: bool) -> Response:
    maps: dict[PairOutput, NDArray[Any]] = {PairOutput.DISPARITY: disparity.disparity_px}
    if metric:
        maps[PairOutput.DEPTH] = disparity.depth_m
    if disparity.confidence is not None and disparity.sigma_px is not None:
        maps[PairOutput.CONFIDENCE] = disparity.confidence
        maps[PairOutput.SIGMA] = disparity.sigma_px
    wanted = maps[query.output]
    match query.format:
        case PairFormat.NPZ:
            response = _binary(lambda file: np.savez(file, allow_pickle=False, **maps))
        case PairFormat.NPY:
            response = _binary(lambda file: np.save(file, wanted, allow_pickle=False))
        case PairFormat.PNG16MM:
            response = _png(encode_depth_mm_png(wanted), beyond=beyond_mm_png(wanted))
        case PairFormat.PNG16 if query.output is PairOutput.CONFIDENCE:
            response = _png(encode_confidence_png(wanted))
        case PairFormat.PNG16 if query.output is PairOutput.SIGMA:
            response = _png(encode_sigma_png(wanted))
        case PairFormat.PNG16:
            response = _png(encode_disparity_png(wanted), beyond=beyond_png(wanted))
    response.headers[RANGE_HEADER] = f"{disparity.max_disparity_px:g}"
    return response


def _png(content: bytes, *, beyond: NDArray[np.bool_] | None = None) -> Response:
    response = Response(content, media_type="image/png")
    if beyond is not None:
        response.headers[BEYOND_HEADER] = str(np.count_nonzero(beyond))
    return response


def _binary(save: Callable[[io.BytesIO], None]) -> Response:
    file = io.BytesIO()
    save(file)
    return Response(file.getvalue(), media_type="application/octet-stream")
