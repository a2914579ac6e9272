"""Images in the forms that cameras have: RGBA, NV12, and files of their own."""

from collections.abc import AsyncIterator
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.support.frames import RIG, make_frame
from tests.support.server import running_server
from tests.support.session_frames import EXACT
from tests.support.shipped_model import shipped_model
from vergence import BadImage, BadShape, Delivery, DepthClient
from vergence_service.inference.model import StereoModel


@pytest.fixture(scope="module")
def model() -> StereoModel:
    return shipped_model()


@pytest.fixture
async def client(model: StereoModel) -> AsyncIterator[DepthClient]:
    async with running_server(model) as server, DepthClient(server.grpc_address) as client:
        yield client


def nv12_of(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    chroma = np.full((grey.shape[0] // 2, grey.shape[1]), 128, np.uint8)
    return np.vstack((grey, chroma))


def jpeg_of(grey: NDArray[np.uint8]) -> bytes:
    return cv2.imencode(".jpg", grey)[1].tobytes()


async def test_an_image_in_a_cameras_own_form_gives_the_result_of_its_pixels(
    client: DepthClient,
) -> None:
    frame = make_frame(1)
    grey = np.ascontiguousarray(frame.left[..., 0])
    decoded = cv2.imdecode(np.frombuffer(jpeg_of(grey), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert decoded is not None
    rgba = np.dstack((frame.left, np.full(grey.shape, 7, np.uint8)))
    forms: list[tuple[Any, Any]] = [
        (rgba, frame.left),
        (nv12_of(grey), grey),
        (jpeg_of(grey), decoded),
    ]
    for form, pixels in forms:
        results = []
        for image in (form, pixels):
            async with client.open_session(RIG, delivery=Delivery.EVERY, output=EXACT) as session:
                results.append(await session.step(image, image))
        np.testing.assert_array_equal(results[0].disparity_px, results[1].disparity_px)


@pytest.mark.parametrize(
    ("image", "error", "says"),
    [
        (
            jpeg_of(np.zeros((48, 80), np.uint8)),
            BadShape,
            "64x48, as the rig has, got a JPEG of 80x48",
        ),
        (jpeg_of(np.zeros((48, 64), np.uint8))[:-40], BadImage, "JPEG"),
        (b"BM and no image", BadImage, "expected a"),
        (np.zeros((48, 64, 5), np.uint8), BadImage, "RGB"),
    ],
    ids=["another size", "cut short", "another kind", "five channels"],
)
async def test_a_file_that_does_not_fit_is_refused_and_the_session_lives_on(
    image: Any, error: type[Exception], says: str, client: DepthClient
) -> None:
    async with client.open_session(RIG, delivery=Delivery.EVERY) as session:
        with pytest.raises(error, match=says):
            await session.step(image, image)
        frame = make_frame(1)
        assert (await session.step(frame.left, frame.right)).step_count == 1
