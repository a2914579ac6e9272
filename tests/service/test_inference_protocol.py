"""Pairs by the Open Inference Protocol v2: health, metadata, tensors, errors."""

import json
from collections.abc import AsyncIterator
from typing import Any

import httpx
import numpy as np
import pytest

from tests.support.http import http_to
from tests.support.server import running_server
from tests.support.weights_copy import WEIGHTS
from vergence_service.inference.onnx_model import OnnxStereoModel
from vergence_service.transports.http.inference_protocol import JSON_LENGTH

HEIGHT, WIDTH, SHIFT_PX = 48, 64, 5
INFER = "/v2/models/matcher/infer"


@pytest.fixture(scope="module")
def model() -> OnnxStereoModel:
    return OnnxStereoModel(WEIGHTS, "matcher", providers=["cpu"], threads=1, allow_spinning=False)


@pytest.fixture
async def web(model: OnnxStereoModel) -> AsyncIterator[httpx.AsyncClient]:
    async with (
        running_server(model, model__min_range_share=0, limits__max_pixels=100_000) as server,
        http_to(server) as client,
    ):
        yield client


def pair() -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    left = np.random.default_rng(0).integers(0, 255, (1, HEIGHT, WIDTH, 3), np.uint8)
    return left, np.roll(left, -SHIFT_PX, axis=2)


def inputs(*, binary: bool, **changes: Any) -> list[dict[str, Any]]:
    described = []
    for name, image in zip(("left", "right"), pair(), strict=True):
        about: dict[str, Any] = {"name": name, "shape": list(image.shape), "datatype": "UINT8"}
        if binary:
            about["parameters"] = {"binary_data_size": image.size}
        else:
            about["data"] = image.ravel().tolist()
        described.append({**about, **changes})
    return described


def binary_request(head: dict[str, Any], *, tail: bytes = b"") -> dict[str, Any]:
    text = json.dumps(head).encode()
    body = text + b"".join(each.tobytes() for each in pair()) + tail
    return {"content": body, "headers": {JSON_LENGTH: str(len(text))}}


def assert_shifted(disparity: np.ndarray[Any, Any]) -> None:
    assert disparity.shape == (1, HEIGHT, WIDTH)
    assert np.median(disparity[0, 8:-8, 20:-8]) == SHIFT_PX
    assert np.isfinite(disparity).all()


async def test_a_server_says_that_it_lives_is_ready_and_what_it_takes(
    web: httpx.AsyncClient,
) -> None:
    for path in ("live", "ready"):
        assert (await web.get(f"/v2/health/{path}")).status_code == 200
    assert (await web.get("/v2")).json()["name"] == "vergence"
    assert (await web.get("/v2/models/matcher/ready")).status_code == 200
    for path in ("/v2/models/matcher", "/v2/models/matcher/versions/1"):
        about = (await web.get(path)).json()
        assert about["name"] == "matcher"
        assert [each["name"] for each in about["inputs"]] == ["left", "right"]
        assert [each["datatype"] for each in about["outputs"]] == ["FP32", "FP32"]
    for path in ("", "/ready", "/config"):
        other = await web.get(f"/v2/models/other{path}")
        assert (other.status_code, "error" in other.json()) == (404, True)


async def test_tensors_in_json_and_in_binary_give_the_same_map(web: httpx.AsyncClient) -> None:
    plain = await web.post(INFER, json={"id": "7", "inputs": inputs(binary=False)})
    assert plain.status_code == 200, plain.text
    answer = plain.json()
    assert (answer["model_name"], answer["id"]) == ("matcher", "7")
    found = {
        each["name"]: np.array(each["data"], np.float32).reshape(each["shape"])
        for each in answer["outputs"]
    }
    assert_shifted(found["disparity"])
    assert (found["sigma"] == 0.5).all()

    wanted = [{"name": "disparity", "parameters": {"binary_data": True}}, {"name": "sigma"}]
    head = {"inputs": inputs(binary=True), "outputs": wanted}
    packed = await web.post(INFER, **binary_request(head))
    assert packed.status_code == 200, packed.text
    length = int(packed.headers[JSON_LENGTH])
    first, second = json.loads(packed.content[:length])["outputs"]
    values = np.frombuffer(packed.content[length:], "<f4").reshape(first["shape"])
    np.testing.assert_array_equal(values, found["disparity"])
    np.testing.assert_array_equal(second["data"], found["sigma"].ravel())


@pytest.mark.parametrize(
    ("change", "status", "says"),
    [
        ({"shape": [1, HEIGHT, WIDTH, 4]}, 400, "expected a shape of [1, H, W, 3]"),
        ({"shape": [1, HEIGHT, WIDTH + 1, 3]}, 400, "for its shape"),
        ({"shape": [1, 10**6, 10**6, 3]}, 413, "at most 100000 pixels"),
        ({"shape": [1, HEIGHT]}, 400, "at least 4 items"),
        ({"datatype": "FP32"}, 400, "UINT8"),
        ({"name": "left"}, 400, "one input left and one input right"),
        ({"parameters": {"binary_data_size": 7}}, 400, "bytes for its shape, got 7"),
    ],
    ids=["channels", "short", "huge", "flat", "type", "twice", "size"],
)
async def test_a_tensor_that_does_not_fit_is_refused_in_the_protocols_own_form(
    web: httpx.AsyncClient, change: dict[str, Any], status: int, says: str
) -> None:
    head = {"inputs": inputs(binary=True, **change)}
    refused = await web.post(INFER, **binary_request(head))
    assert refused.status_code == status
    assert says in refused.json()["error"]


async def test_a_damaged_request_is_refused(web: httpx.AsyncClient) -> None:
    good = {"inputs": inputs(binary=True)}
    for request, says in (
        ({"content": b"{"}, "JSON"),
        ({"json": {"inputs": inputs(binary=False, data=[1, 2, 300])}}, "from 0 to 255"),
        ({"json": {"inputs": inputs(binary=False, data=[[1], [2, 3]])}}, "from 0 to 255"),
        ({"json": {"inputs": inputs(binary=False, data=None)}}, "from 0 to 255"),
        (binary_request(good, tail=b"x"), "more bytes than its tensors"),
        ({**binary_request(good), "headers": {JSON_LENGTH: "-5"}}, "a number of bytes"),
        ({**binary_request(good), "headers": {JSON_LENGTH: "9" * 30}}, "bytes of JSON"),
        ({"content": b" " * (9 << 20)}, "send the tensors as binary data"),
    ):
        refused = await web.post(INFER, **request)
        assert refused.status_code in (400, 413), refused.text
        assert says in refused.json()["error"]
    assert (await web.post(INFER, **binary_request(good))).status_code == 200
