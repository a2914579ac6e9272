"""The real server with the tiny model, and a client of it."""

from collections.abc import AsyncIterator

import pytest

from tests.support.models import RecallModel
from tests.support.server import running_server
from vergence import DepthClient
from vergence_service.app.server import Running


@pytest.fixture
def model() -> RecallModel:
    return RecallModel()


@pytest.fixture
async def server(model: RecallModel) -> AsyncIterator[Running]:
    async with running_server(model) as server:
        yield server


@pytest.fixture
async def client(server: Running) -> AsyncIterator[DepthClient]:
    async with DepthClient(server.grpc_address) as client:
        yield client
