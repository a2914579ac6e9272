"""The law of the way back: a map's pixel is where the server looked for it."""

from collections.abc import AsyncIterator, Sequence

import cv2
import numpy as np
import pytest

from tests.support.models import RecallModel
from tests.support.server import running_server
from vergence import Delivery, DepthClient, Distortion, Intrinsics, Pose, StereoRig
from vergence_service.inference.model import Step, StepResult

WIDTH, HEIGHT = 64, 48
TURNED = Pose.from_xyzw(np.array([0.005, -0.015, 0.01, 1.0]), np.array([0.1, 0.002, 0.001]))
LENSES = {
    "none": (Distortion.NONE, ()),
    "brown-conrady": (Distortion.BROWN_CONRADY, (-0.2, 0.05, 0.001, -0.002, 0.01)),
    "fisheye": (Distortion.KANNALA_BRANDT, (0.02, -0.01, 0.002, 0.0)),
}


class SeeingModel(RecallModel):
    """Keeps the left images that it was given: those are rectified."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[np.ndarray[tuple[int, ...], np.dtype[np.uint8]]] = []

    def step(self, steps: Sequence[Step]) -> list[StepResult]:
        self.seen += [each.view.left.copy() for each in steps]
        return super().step(steps)


@pytest.fixture
def model() -> SeeingModel:
    return SeeingModel()


@pytest.fixture
async def client(model: SeeingModel) -> AsyncIterator[DepthClient]:
    async with running_server(model) as server, DepthClient(server.grpc_address) as client:
        yield client


@pytest.mark.parametrize("lens", LENSES)
async def test_a_maps_pixel_is_where_the_server_looked_for_it(
    lens: str, client: DepthClient, model: SeeingModel
) -> None:
    camera = Intrinsics(WIDTH, HEIGHT, 60.0, 58.0, 30.0, 25.0, *LENSES[lens])
    rig = StereoRig(camera, camera, TURNED)
    # Smooth: the server samples at 1/32 px.
    x, y = np.meshgrid(np.linspace(0, 200, WIDTH), np.linspace(0, 50, HEIGHT))
    image = (x + y).astype(np.uint8)
    async with client.open_session(rig, delivery=Delivery.EVERY) as session:
        await session.step(image, image)
        pixels = session.image_pixels()
        assert pixels.shape == (session.rig.height, session.rig.width, 2)
        assert not np.allclose(session.left_from_rectified.rotation, np.eye(3), atol=1e-4)
    (rectified,) = model.seen
    ours = cv2.remap(image, pixels[..., 0], pixels[..., 1], cv2.INTER_LINEAR)
    columns, rows = pixels[..., 0], pixels[..., 1]
    inside = (columns > 1) & (columns < WIDTH - 2) & (rows > 1) & (rows < HEIGHT - 2)
    difference = np.abs(ours.astype(int) - rectified[..., 0])
    assert inside.mean() > 0.5
    assert difference[inside].max() <= 1


async def test_a_rectified_rig_has_the_images_pixels(client: DepthClient) -> None:
    camera = Intrinsics(WIDTH, HEIGHT, 60.0, 60.0, 31.5, 23.5)
    rig = StereoRig(camera, camera, Pose(np.eye(3), np.array([0.1, 0.0, 0.0])))
    async with client.open_session(rig) as session:
        np.testing.assert_array_equal(session.left_from_rectified.matrix, np.eye(4))
        columns, rows = np.moveaxis(session.image_pixels(), -1, 0)
    np.testing.assert_allclose(
        columns, np.broadcast_to(np.arange(WIDTH), (HEIGHT, WIDTH)), atol=1e-5
    )
    np.testing.assert_allclose(
        rows, np.broadcast_to(np.arange(HEIGHT)[:, None], (HEIGHT, WIDTH)), atol=1e-5
    )
