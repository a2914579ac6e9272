"""A client's memory does not grow with its sessions, nor with the frames of a session."""

import gc
from collections.abc import AsyncIterator

import pytest

from tests.support.frames import RIG, make_frame
from tests.support.models import RecallModel
from tests.support.polling import eventually
from tests.support.server import running_server
from vergence import Delivery, DepthClient

pytestmark = pytest.mark.slow

MANY = 60
# Caches fill, and a few objects of the event loop come and go. A leak of one object for each frame
# or session is twice as large.
MOST_MORE = MANY // 2


def objects() -> int:
    for _ in range(3):
        gc.collect()
    return len(gc.get_objects())


@pytest.fixture(params=["grpc", "http"])
async def client(request: pytest.FixtureRequest) -> AsyncIterator[DepthClient]:
    async with running_server(RecallModel()) as server:
        url = {"grpc": server.grpc_address, "http": f"http://{server.http_address}"}
        async with DepthClient(url[request.param]) as client:
            yield client


async def test_sessions_leave_nothing_behind(client: DepthClient) -> None:
    frame = make_frame(1)

    async def film() -> None:
        for _ in range(MANY):
            async with client.open_session(RIG, delivery=Delivery.EVERY) as session:
                await session.step(frame.left, frame.right)

    await film()
    before = objects()
    await film()
    await eventually(lambda: objects() - before < MOST_MORE)  # closed connections go last


async def test_frames_leave_nothing_behind(client: DepthClient) -> None:
    frame = make_frame(1)
    async with client.open_session(RIG, delivery=Delivery.EVERY) as session:
        for _ in range(600):  # what is kept of the latest frames is full then
            await session.step(frame.left, frame.right)
        before = objects()
        for _ in range(MANY):
            await session.step(frame.left, frame.right)
        await eventually(lambda: objects() - before < MOST_MORE)
