"""Single pairs by the Open Inference Protocol v2, as inference servers speak it over HTTP.

Its clients and its tools for measuring work as they are.
"""

import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from fastapi import APIRouter, Request, Response
from fastapi import Path as PathParameter
from fastapi.responses import JSONResponse
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from vergence_proto.errors import BadShape, DepthError, UploadTooLarge
from vergence_proto.types import Image
from vergence_service.jobs.places import Places
from vergence_service.streams.engine import DepthEngine
from vergence_service.transports import open_inference
from vergence_service.transports.callers import CALLER
from vergence_service.transports.http.errors import HTTP_STATUS
from vergence_service.transports.http.uploads import UploadLimits, body_chunks, while_connected
from vergence_service.transports.open_inference import MODEL_VERSION, Maps

JSON_LENGTH = "Inference-Header-Content-Length"  # bytes of JSON before the binary tensors
_LARGEST_JSON = 8 << 20  # its numbers take a dozen times the memory


class _Parameters(BaseModel):
    """Those of the extension for binary tensors; others are ignored, as the protocol asks."""

    model_config = ConfigDict(extra="ignore")

    binary_data_size: int | None = Field(default=None, ge=0)
    binary_data: bool = False
    binary_data_output: bool = False


class _Input(BaseModel):
    name: Literal["left", "right"]
    shape: Annotated[list[int], Field(min_length=4, max_length=4)]
    datatype: Literal["UINT8"]
    parameters: _Parameters = _Parameters()
    data: list[Any] | None = None


class _Output(BaseModel):
    name: Literal["disparity", "sigma"]
    parameters: _Parameters = _Parameters()


class _InferRequest(BaseModel):
    model_config = ConfigDict(extra="ignore")

    id: Annotated[str, Field(max_length=200)] = ""
    parameters: _Parameters = _Parameters()
    inputs: Annotated[list[_Input], Field(min_length=2, max_length=2)]
    outputs: Annotated[list[_Output], Field(max_length=2)] = []


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    request: _InferRequest
    left: Image
    right: Image


def inference_routes(engine: DepthEngine, places: Places, *, limits: UploadLimits) -> APIRouter:
    """Make the routes below /v2. Pairs share the ``places`` of /v1/pairs."""
    # The protocol has a schema of its own, and errors of its own.
    router = APIRouter(include_in_schema=False)
    model_paths = ("/v2/models/{model}", f"/v2/models/{{model}}/versions/{MODEL_VERSION}")

    @router.get("/v2")
    async def server() -> dict[str, Any]:
        return {
            "name": open_inference.SERVER,
            "version": open_inference.server_version(),
            "extensions": ["binary_tensor_data", open_inference.CONFIGURATION],
        }

    @router.get("/v2/health/live")
    async def live() -> Response:
        return Response()

    @router.get("/v2/health/ready")
    async def ready() -> Response:
        return Response(status_code=200 if engine.ready else 503)

    async def model_ready(model: Annotated[str, PathParameter()]) -> Response:
        if (missing := open_inference.no_such_model(model, "", engine)) is not None:
            return _unknown(missing)
        return Response(status_code=200 if engine.ready else 503)

    async def model_metadata(model: Annotated[str, PathParameter()]) -> Response:
        if (missing := open_inference.no_such_model(model, "", engine)) is not None:
            return _unknown(missing)
        return JSONResponse(_metadata(engine))

    async def model_config(model: Annotated[str, PathParameter()]) -> Response:
        if (missing := open_inference.no_such_model(model, "", engine)) is not None:
            return _unknown(missing)
        return JSONResponse(_config(engine))

    async def infer(model: Annotated[str, PathParameter()], request: Request) -> Response:
        if (missing := open_inference.no_such_model(model, "", engine)) is not None:
            return _unknown(missing)
        try:
            places.check(CALLER.get())  # before the upload, which would be for nothing
            with tempfile.TemporaryDirectory() as scratch:
                body = Path(scratch) / "body"
                with body.open("wb") as file:
                    async for chunk in body_chunks(request, limits):
                        await engine.threads.background.run(file.write, chunk)
                async with while_connected(request), places.taken(CALLER.get()):
                    length = request.headers.get(JSON_LENGTH)
                    return await _inferred(engine, body, length)
        except DepthError as error:
            return _error(error)

    for path in model_paths:
        router.add_api_route(path, model_metadata, methods=["GET"], response_model=None)
        router.add_api_route(f"{path}/ready", model_ready, methods=["GET"], response_model=None)
        router.add_api_route(f"{path}/config", model_config, methods=["GET"], response_model=None)
        router.add_api_route(f"{path}/infer", infer, methods=["POST"], response_model=None)
    return router


async def _inferred(engine: DepthEngine, body: Path, json_length: str | None) -> Response:
    background = engine.threads.background
    pair = await background.run(_pair_of, body, json_length, engine.max_pixels)
    maps = await open_inference.step_pair(engine, pair.left, pair.right)
    return await background.run(_answer, engine.card.name, pair.request, maps)


def _metadata(engine: DepthEngine) -> dict[str, Any]:
    inputs = [
        {"name": each, "datatype": open_inference.INPUT_TYPE, "shape": open_inference.INPUT_SHAPE}
        for each in open_inference.INPUTS
    ]
    outputs = [
        {"name": each, "datatype": open_inference.OUTPUT_TYPE, "shape": open_inference.OUTPUT_SHAPE}
        for each in open_inference.OUTPUTS
    ]
    return {
        "name": engine.card.name,
        "versions": [MODEL_VERSION],
        "platform": engine.computed_by,
        "inputs": inputs,
        "outputs": outputs,
    }


def _config(engine: DepthEngine) -> dict[str, Any]:
    """Return what Triton's tools for measuring ask for, beside the metadata."""
    inputs, outputs = (
        [{"name": name, "data_type": f"TYPE_{kind}", "dims": shape} for name in names]
        for names, kind, shape in (
            (open_inference.INPUTS, open_inference.INPUT_TYPE, open_inference.INPUT_SHAPE),
            (open_inference.OUTPUTS, open_inference.OUTPUT_TYPE, open_inference.OUTPUT_SHAPE),
        )
    )
    return {
        "name": engine.card.name,
        "platform": engine.computed_by,
        "max_batch_size": 0,  # one pair a request
        "input": inputs,
        "output": outputs,
    }


def _pair_of(body: Path, json_length: str | None, max_pixels: int) -> _Pair:
    """Read a request. Raises BadShape, FrameTooLarge or UploadTooLarge."""
    size = body.stat().st_size
    if json_length is not None and not (json_length.isascii() and json_length.isdigit()):
        raise BadShape(f"expected a number of bytes in {JSON_LENGTH}, got {json_length[:40]!r}")
    length = size if json_length is None else int(json_length[:20])
    if length > size:
        raise BadShape(f"expected {length} bytes of JSON, got a body of {size}")
    if length > _LARGEST_JSON:
        raise UploadTooLarge(
            f"expected JSON of at most {_LARGEST_JSON} bytes; send the tensors as binary data"
        )
    with body.open("rb") as file:
        try:
            request = _InferRequest.model_validate_json(file.read(length))
        except ValidationError as error:
            problems = "; ".join(
                f"{'.'.join(map(str, each['loc']))}: {each['msg']}" for each in error.errors()[:3]
            )
            raise BadShape(problems) from None
        open_inference.check_inputs([each.name for each in request.inputs])
        images = {each.name: _image_of(each, file, max_pixels) for each in request.inputs}
        if file.read(1):
            raise BadShape("the body holds more bytes than its tensors")
    left, right = images["left"], images["right"]
    open_inference.check_pair(left, right)
    return _Pair(request, left, right)


def _image_of(given: _Input, file: Any, max_pixels: int) -> Image:
    count = open_inference.check_shape(given.name, given.shape, max_pixels=max_pixels)
    size = given.parameters.binary_data_size
    if size is not None:
        if size != count:
            raise BadShape(f"{given.name}: expected {count} bytes for its shape, got {size}")
        values = np.frombuffer(file.read(count), np.uint8)
    else:
        values = _bytes_of(given)
    return open_inference.image_of(given.name, given.shape, values)


def _bytes_of(given: _Input) -> NDArray[np.uint8]:
    """The values in JSON: flat, or in lists of lists."""
    try:
        numbers = np.asarray(given.data if given.data is not None else [])
    except ValueError:  # lists of different lengths
        numbers = np.empty(0)
    if numbers.dtype.kind not in "iu":
        raise BadShape(f"{given.name}: expected whole numbers from 0 to 255 in its values")
    return open_inference.bytes_of(given.name, numbers)


def _answer(model: str, request: _InferRequest, maps: Maps) -> Response:
    all_binary = request.parameters.binary_data_output
    wanted: Sequence[tuple[str, bool]] = [
        (each.name, each.parameters.binary_data) for each in request.outputs
    ] or [(name, all_binary) for name in maps]
    described: list[dict[str, Any]] = []
    tensors: list[bytes] = []
    for name, binary in wanted:
        values = maps[name]
        about: dict[str, Any] = {"name": name, "datatype": "FP32", "shape": [1, *values.shape]}
        if binary:
            tensors.append(values.astype("<f4").tobytes())
            about["parameters"] = {"binary_data_size": len(tensors[-1])}
        else:
            about["data"] = values.ravel().tolist()
        described.append(about)
    answer: dict[str, Any] = {
        "model_name": model,
        "model_version": MODEL_VERSION,
        "outputs": described,
    }
    if request.id:
        answer["id"] = request.id
    head = json.dumps(answer).encode()
    if not tensors:
        return Response(head, media_type="application/json")
    headers = {JSON_LENGTH: str(len(head))}
    body = b"".join([head, *tensors])
    return Response(body, media_type="application/octet-stream", headers=headers)


def _unknown(missing: str) -> Response:
    return JSONResponse({"error": missing}, 404)


def _error(error: DepthError) -> Response:
    return JSONResponse({"error": str(error)}, HTTP_STATUS[error.code])
