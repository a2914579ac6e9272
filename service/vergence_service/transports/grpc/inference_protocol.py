"""inference.GRPCInferenceService: single pairs by the Open Inference Protocol v2, over gRPC.

Its clients and its tools for measuring work as they are.
"""

from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import grpc
import numpy as np
from google.protobuf.message import DecodeError, Message

from vergence_proto.codec import read_small
from vergence_proto.codec.wire import fields_of
from vergence_proto.errors import BadShape, FrameTooLarge
from vergence_proto.open_inference import inference_pb2 as pb
from vergence_proto.types import Image
from vergence_service.jobs.places import Places
from vergence_service.streams.engine import DepthEngine
from vergence_service.transports import open_inference
from vergence_service.transports.callers import CALLER
from vergence_service.transports.grpc.errors import Context, errors_as_status
from vergence_service.transports.open_inference import Maps

SERVICE = pb.DESCRIPTOR.services_by_name["GRPCInferenceService"].full_name

_RAW = pb.ModelInferRequest.RAW_INPUT_CONTENTS_FIELD_NUMBER
# A request has two inputs and two outputs, and few parameters. The fields are walked in Python.
_MOST_FIELDS = 64
# Protobuf parses everything but raw tensors. Numbers in the message take four times their bytes.
_MOST_BESIDE_RAW = 4 << 20

_Answer = Callable[[Any, Context], Awaitable[Message]]


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    request: pb.ModelInferRequest
    left: Image
    right: Image
    raw: bool  # the images came as bytes, not as numbers


class InferenceServicer:
    """Answers the calls of the service. Pairs share the ``places`` of /v1/pairs."""

    def __init__(self, engine: DepthEngine, places: Places, *, max_frame_bytes: int) -> None:
        self._engine = engine
        self._places = places
        self._max_frame_bytes = max_frame_bytes
        small: dict[str, tuple[type[Message], _Answer]] = {
            "ServerLive": (pb.ServerLiveRequest, self._server_live),
            "ServerReady": (pb.ServerReadyRequest, self._server_ready),
            "ModelReady": (pb.ModelReadyRequest, self._model_ready),
            "ServerMetadata": (pb.ServerMetadataRequest, self._server_metadata),
            "ModelMetadata": (pb.ModelMetadataRequest, self._model_metadata),
            "ModelConfig": (pb.ModelConfigRequest, self._model_config),
        }
        self.handlers: dict[str, grpc.RpcMethodHandler[Any, Any]] = {
            "ModelInfer": grpc.unary_unary_rpc_method_handler(self._model_infer),
            **{name: _small(*answer) for name, answer in small.items()},
        }

    async def _server_live(
        self, _: pb.ServerLiveRequest, context: Context
    ) -> pb.ServerLiveResponse:
        return pb.ServerLiveResponse(live=True)

    async def _server_ready(
        self, _: pb.ServerReadyRequest, context: Context
    ) -> pb.ServerReadyResponse:
        return pb.ServerReadyResponse(ready=self._engine.ready)

    async def _model_ready(
        self, request: pb.ModelReadyRequest, context: Context
    ) -> pb.ModelReadyResponse:
        await self._check_model(request.name, request.version, context)
        return pb.ModelReadyResponse(ready=self._engine.ready)

    async def _server_metadata(
        self, _: pb.ServerMetadataRequest, context: Context
    ) -> pb.ServerMetadataResponse:
        return pb.ServerMetadataResponse(
            name=open_inference.SERVER,
            version=open_inference.server_version(),
            extensions=[open_inference.CONFIGURATION],
        )

    async def _model_metadata(
        self, request: pb.ModelMetadataRequest, context: Context
    ) -> pb.ModelMetadataResponse:
        await self._check_model(request.name, request.version, context)
        tensor = pb.ModelMetadataResponse.TensorMetadata
        taken = partial(
            tensor, datatype=open_inference.INPUT_TYPE, shape=open_inference.INPUT_SHAPE
        )
        given = partial(
            tensor, datatype=open_inference.OUTPUT_TYPE, shape=open_inference.OUTPUT_SHAPE
        )
        return pb.ModelMetadataResponse(
            name=self._engine.card.name,
            versions=[open_inference.MODEL_VERSION],
            platform=self._engine.computed_by,
            inputs=[taken(name=each) for each in open_inference.INPUTS],
            outputs=[given(name=each) for each in open_inference.OUTPUTS],
        )

    async def _model_config(
        self, request: pb.ModelConfigRequest, context: Context
    ) -> pb.ModelConfigResponse:
        await self._check_model(request.name, request.version, context)
        taken = partial(pb.ModelInput, data_type=pb.TYPE_UINT8, dims=open_inference.INPUT_SHAPE)
        given = partial(pb.ModelOutput, data_type=pb.TYPE_FP32, dims=open_inference.OUTPUT_SHAPE)
        config = pb.ModelConfig(
            name=self._engine.card.name,
            platform=self._engine.computed_by,
            input=[taken(name=each) for each in open_inference.INPUTS],
            output=[given(name=each) for each in open_inference.OUTPUTS],
        )
        return pb.ModelConfigResponse(config=config)

    async def _model_infer(self, request: bytes, context: Context) -> bytes:
        async with errors_as_status(context):
            if len(request) > self._max_frame_bytes:
                raise FrameTooLarge(
                    f"expected a message of at most {self._max_frame_bytes} bytes "
                    f"(limits.max_frame_mib), got {len(request)}"
                )
            background = self._engine.threads.background
            async with self._places.taken(CALLER.get()):
                pair = await background.run(_pair_of, request, self._engine.max_pixels)
                await self._check_model(
                    pair.request.model_name, pair.request.model_version, context
                )
                maps = await open_inference.step_pair(self._engine, pair.left, pair.right)
                return await background.run(_answer, self._engine.card.name, pair, maps)

    async def _check_model(self, name: str, version: str, context: Context) -> None:
        missing = open_inference.no_such_model(name, version, self._engine)
        if missing is not None:
            await context.abort(grpc.StatusCode.NOT_FOUND, missing)


def _small(question: type[Message], answer: _Answer) -> "grpc.RpcMethodHandler[Any, Any]":
    async def handle(request: bytes, context: Context) -> bytes:
        async with errors_as_status(context):
            return (await answer(read_small(question, request), context)).SerializeToString()

    return grpc.unary_unary_rpc_method_handler(handle)


def _pair_of(message: bytes, max_pixels: int) -> _Pair:
    """Read a request. Raises BadShape or FrameTooLarge."""
    request, tensors = _read(message)
    open_inference.check_inputs([each.name for each in request.inputs])
    wanted = [each.name for each in request.outputs]
    if not set(wanted) <= set(open_inference.OUTPUTS) or len(wanted) > len(open_inference.OUTPUTS):
        raise BadShape("expected the outputs disparity and sigma, or one of them")
    if tensors and len(tensors) != len(request.inputs):
        raise BadShape(f"expected {len(request.inputs)} raw tensors, got {len(tensors)}")
    images = {
        each.name: _image_of(each, tensors[place] if tensors else None, max_pixels)
        for place, each in enumerate(request.inputs)
    }
    left, right = (images[name] for name in open_inference.INPUTS)
    open_inference.check_pair(left, right)
    return _Pair(request, left, right, raw=bool(tensors))


def _read(message: bytes) -> tuple[pb.ModelInferRequest, Sequence[memoryview]]:
    """Return the request without its raw tensors, and these as views of the ``message``."""
    beside: list[memoryview] = []
    tensors: list[memoryview] = []
    size = 0
    try:
        for count, field in enumerate(fields_of(memoryview(message)), start=1):
            if count > _MOST_FIELDS:
                raise BadShape(f"expected at most {_MOST_FIELDS} fields, got more")
            if field.number == _RAW and field.content is not None:
                tensors.append(field.content)
                continue
            size += len(field.whole)
            if size > _MOST_BESIDE_RAW:
                raise FrameTooLarge(
                    f"expected at most {_MOST_BESIDE_RAW} bytes of numbers; send the tensors in "
                    "raw_input_contents"
                )
            beside.append(field.whole)
        return pb.ModelInferRequest.FromString(b"".join(beside)), tensors
    except (ValueError, DecodeError):
        raise BadShape("expected a ModelInferRequest, got other bytes") from None


def _image_of(
    given: pb.ModelInferRequest.InferInputTensor, raw: memoryview | None, max_pixels: int
) -> Image:
    name = given.name
    if given.datatype != open_inference.INPUT_TYPE:
        raise BadShape(
            f"{name}: expected the datatype {open_inference.INPUT_TYPE}, got "
            f"{given.datatype[:40]!r}"
        )
    if len(given.shape) > 4:
        raise BadShape(f"{name}: expected a shape of [1, H, W, 3], got {len(given.shape)} sizes")
    shape = list(given.shape)
    open_inference.check_shape(name, shape, max_pixels=max_pixels)
    if raw is not None:
        if given.HasField("contents"):
            raise BadShape(f"{name}: expected contents or raw_input_contents, got both")
        return open_inference.image_of(name, shape, np.frombuffer(raw, np.uint8))
    numbers = np.array(given.contents.uint_contents, np.uint32)
    return open_inference.image_of(name, shape, open_inference.bytes_of(name, numbers))


def _answer(model: str, pair: _Pair, maps: Maps) -> bytes:
    answer = pb.ModelInferResponse(
        model_name=model, model_version=open_inference.MODEL_VERSION, id=pair.request.id
    )
    for name in [each.name for each in pair.request.outputs] or open_inference.OUTPUTS:
        values = maps[name]
        described = answer.outputs.add(
            name=name, datatype=open_inference.OUTPUT_TYPE, shape=(1, *values.shape)
        )
        if pair.raw:
            answer.raw_output_contents.append(values.astype("<f4").tobytes())
        else:
            described.contents.fp32_contents.extend(values.ravel().tolist())
    return answer.SerializeToString()
