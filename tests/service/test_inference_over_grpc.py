"""Pairs by the Open Inference Protocol v2 over gRPC; Triton's own clients over gRPC and HTTP."""

from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
import tritonclient.grpc.aio as triton_grpc
import tritonclient.http.aio as triton_http
from google.protobuf.descriptor import Descriptor
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc
from tritonclient.grpc import model_config_pb2 as published_config
from tritonclient.grpc import service_pb2 as published
from tritonclient.utils import InferenceServerException

from tests.support.server import PATIENCE_S, running_server
from tests.support.tokens import TokenFile
from tests.support.weights_copy import WEIGHTS
from vergence_proto.codec.wire import delimited
from vergence_proto.open_inference import inference_pb2 as pb
from vergence_service.app.server import Running
from vergence_service.inference.onnx_model import OnnxStereoModel

HEIGHT, WIDTH, SHIFT_PX = 48, 64, 5
SERVICE = "inference.GRPCInferenceService"
Infer = Callable[[bytes], Awaitable[pb.ModelInferResponse]]


@pytest.fixture(scope="module")
def model() -> OnnxStereoModel:
    return OnnxStereoModel(WEIGHTS, "matcher", providers=["cpu"], threads=1, allow_spinning=False)


def pair() -> dict[str, np.ndarray[Any, Any]]:
    left = np.random.default_rng(0).integers(0, 255, (1, HEIGHT, WIDTH, 3), np.uint8)
    return {"right": np.roll(left, -SHIFT_PX, axis=2), "left": left}  # any order


def request(**changes: Any) -> pb.ModelInferRequest:
    tensor = pb.ModelInferRequest.InferInputTensor
    shape = changes.pop("shape", [1, HEIGHT, WIDTH, 3])
    datatype = changes.pop("datatype", "UINT8")
    return pb.ModelInferRequest(
        model_name=changes.pop("model_name", "matcher"),
        inputs=[tensor(name=name, datatype=datatype, shape=shape) for name in pair()],
        raw_input_contents=changes.pop("raw", [each.tobytes() for each in pair().values()]),
        **changes,
    )


def assert_shifted(disparity: np.ndarray[Any, Any]) -> None:
    assert disparity.shape == (1, HEIGHT, WIDTH)
    assert np.median(disparity[0, 8:-8, 20:-8]) == SHIFT_PX


async def inferred(client: Any, kind: Any) -> list[np.ndarray[Any, Any]]:
    inputs = [kind.InferInput(name, image.shape, "UINT8") for name, image in pair().items()]
    for tensor, image in zip(inputs, pair().values(), strict=True):
        tensor.set_data_from_numpy(image)
    found = await client.infer("matcher", inputs, request_id="7")
    return [found.as_numpy(name) for name in ("disparity", "sigma")]


def config_of(config: Any) -> dict[str, tuple[str, list[int]]]:
    """Type and shape of each tensor in a configuration, from JSON or from a message."""
    if isinstance(config, dict):
        tensors = config["input"] + config["output"]
        return {
            each["name"]: (each["data_type"].removeprefix("TYPE_"), each["dims"])
            for each in tensors
        }
    kind = published_config.DataType.Name
    return {
        each.name: (kind(each.data_type).removeprefix("TYPE_"), list(each.dims))
        for each in (*config.input, *config.output)
    }


async def test_tritons_clients_infer_a_pair_over_grpc_and_http(model: OnnxStereoModel) -> None:
    answers = []
    async with running_server(model, model__min_range_share=0) as server:
        for kind, address in (
            (triton_grpc, server.grpc_address),
            (triton_http, server.http_address),
        ):
            async with kind.InferenceServerClient(address) as client:
                assert await client.is_server_live()
                assert await client.is_server_ready()
                assert await client.is_model_ready("matcher", "1")
                about = await client.get_model_metadata("matcher")
                inputs = about["inputs"] if isinstance(about, dict) else about.inputs
                named = [each["name"] if isinstance(each, dict) else each.name for each in inputs]
                assert named == ["left", "right"]
                config = await client.get_model_config("matcher")
                config = config if isinstance(config, dict) else config.config
                assert config_of(config) == {
                    "left": ("UINT8", [1, -1, -1, 3]),
                    "right": ("UINT8", [1, -1, -1, 3]),
                    "disparity": ("FP32", [1, -1, -1]),
                    "sigma": ("FP32", [1, -1, -1]),
                }
                answers.append(await inferred(client, kind))
                with pytest.raises(InferenceServerException, match="there is no model 'other'"):
                    await client.get_model_metadata("other")
    assert_shifted(answers[0][0])
    for over_grpc, over_http in zip(*answers, strict=True):
        np.testing.assert_array_equal(over_grpc, over_http)


def fields(message: Descriptor) -> dict[str, Any]:
    """Numbers, types and meanings of a message's fields, and of the messages in it."""
    return {
        each.name: (
            each.number,
            each.type,
            each.is_repeated,
            each.containing_oneof and each.containing_oneof.name,
            fields(each.message_type) if each.message_type else None,
        )
        for each in message.fields
    }


def assert_part_of(ours: dict[str, Any], theirs: dict[str, Any]) -> None:
    for name, (*about, inner) in ours.items():
        *their_about, their_inner = theirs[name]
        assert about == their_about, name
        if inner is not None:
            assert_part_of(inner, their_inner)


def test_every_message_is_that_of_the_published_protocol() -> None:
    theirs = published.DESCRIPTOR.message_types_by_name
    configs = published_config.DESCRIPTOR.message_types_by_name
    for name, ours in pb.DESCRIPTOR.message_types_by_name.items():
        if "Config" in name or name in configs:  # the configuration of Triton has more fields
            assert_part_of(fields(ours), fields({**theirs, **configs}[name]))
        else:
            assert fields(ours) == fields(theirs[name]), name
    numbers = published_config.DataType.items()
    assert set(pb.DataType.items()) <= set(numbers)
    service = published.DESCRIPTOR.services_by_name["GRPCInferenceService"].methods_by_name
    for method in pb.DESCRIPTOR.services_by_name["GRPCInferenceService"].methods:
        assert method.input_type.name == service[method.name].input_type.name
        assert method.output_type.name == service[method.name].output_type.name


async def refused(infer: Infer, message: bytes, code: grpc.StatusCode, says: str) -> None:
    with pytest.raises(grpc.aio.AioRpcError) as error:
        await infer(message)
    assert error.value.code() is code, error.value.details()
    assert says in (error.value.details() or "")


def infer_of(channel: grpc.aio.Channel) -> Infer:
    call = channel.unary_unary(
        f"/{SERVICE}/ModelInfer",
        request_serializer=None,
        response_deserializer=pb.ModelInferResponse.FromString,
    )
    return lambda message: call(message, timeout=PATIENCE_S)


async def test_numbers_give_the_map_that_bytes_give_and_what_does_not_fit_is_refused(
    model: OnnxStereoModel,
) -> None:
    bad, large = grpc.StatusCode.INVALID_ARGUMENT, grpc.StatusCode.RESOURCE_EXHAUSTED
    numbers = request(raw=[], outputs=[{"name": "disparity"}], id="7")
    for tensor, image in zip(numbers.inputs, pair().values(), strict=True):
        tensor.contents.uint_contents.extend(image.ravel().tolist())
    both, twice = request(), request()
    both.inputs[0].contents.uint_contents.append(1)
    twice.inputs[0].name = "left"
    over = pb.ModelInferRequest.FromString(numbers.SerializeToString())
    over.inputs[0].contents.uint_contents[0] = 256
    short = request(raw=[b"x", b"y"])
    three = ["disparity", "sigma", "sigma"]
    filler = b"".join(delimited(99, b"x" * (9 << 19)))
    async with (
        running_server(
            model, model__min_range_share=0, limits__max_pixels=100_000, limits__max_frame_mib=8
        ) as server,
        grpc.aio.insecure_channel(server.grpc_address) as channel,
    ):
        infer = infer_of(channel)
        plain, raw = (
            await infer(numbers.SerializeToString()),
            await infer(request().SerializeToString()),
        )
        assert (plain.id, plain.model_name, [each.name for each in plain.outputs]) == (
            "7",
            "matcher",
            ["disparity"],
        )
        found = np.array(plain.outputs[0].contents.fp32_contents, np.float32)
        assert_shifted(found.reshape(list(plain.outputs[0].shape)))
        np.testing.assert_array_equal(found, np.frombuffer(raw.raw_output_contents[0], "<f4"))

        for message, code, says in (
            (request(model_name="other"), grpc.StatusCode.NOT_FOUND, "only matcher"),
            (request(model_version="2"), grpc.StatusCode.NOT_FOUND, "no version '2'"),
            (request(shape=[1, HEIGHT, WIDTH, 4]), bad, "a shape of [1, H, W, 3]"),
            (request(shape=[1] * 1000), bad, "got 1000 sizes"),
            (request(shape=[1, HEIGHT, WIDTH + 1, 3]), bad, "for its shape"),
            (request(shape=[1, 10**6, 10**6, 3]), large, "at most 100000 pixels"),
            (request(datatype="FP32"), bad, "expected the datatype UINT8"),
            (request(raw=[b"x"]), bad, "expected 2 raw tensors, got 1"),
            (request(raw=[]), bad, "for its shape, got 0"),
            (request(outputs=[{"name": "depth"}]), bad, "the outputs disparity and sigma"),
            (request(outputs=[{"name": name} for name in three]), bad, "disparity and sigma"),
            (short, bad, "for its shape, got 1"),
            (twice, bad, "one input left and one input right"),
            (both, bad, "got both"),
            (over, bad, "from 0 to 255"),
        ):
            await refused(infer, message.SerializeToString(), code, says)
        for damaged, code, says in (
            (b"\xff", bad, "expected a ModelInferRequest"),
            (b"\x1a\x02\xff\xfe", bad, "expected a ModelInferRequest"),  # an id that is no text
            (b"\x2a\x00" * 1000, bad, "at most 64 fields"),
            (filler, large, "send the tensors in raw_input_contents"),
            (filler * 2, large, "limits.max_frame_mib"),
        ):
            await refused(infer, damaged, code, says)
        assert (await infer(request().SerializeToString())).outputs


async def test_the_service_is_behind_the_gate_and_describes_itself(
    model: OnnxStereoModel, tmp_path: Path
) -> None:
    file = TokenFile(tmp_path / "tokens.toml", "ana", admins=("root",))
    async with running_server(
        model, model__min_range_share=0, security__tokens=file.path
    ) as server:
        await assert_guarded(server, file)
        async with grpc.aio.insecure_channel(server.grpc_address) as channel:
            reflect = reflection_pb2_grpc.ServerReflectionStub(channel).ServerReflectionInfo
            asked = reflection_pb2.ServerReflectionRequest(file_containing_symbol=SERVICE)
            answers = reflect(iter([asked]), metadata=tuple(file.shown("root").items()))
            async for answer in answers:
                (described,) = answer.file_descriptor_response.file_descriptor_proto
                assert described == pb.DESCRIPTOR.serialized_pb


async def assert_guarded(server: Running, file: TokenFile) -> None:
    async with triton_grpc.InferenceServerClient(server.grpc_address) as client:
        assert await client.is_server_live(headers=file.shown("ana"))
        for call in (client.is_server_live(), client.get_model_metadata("matcher")):
            with pytest.raises(InferenceServerException, match="UNAUTHENTICATED"):
                await call
