"""Servers that Zenoh leads to, and sessions with them."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from tests.support.frames import make_frame
from tests.support.models import RecallModel
from tests.support.server import running_server
from tests.support.zenoh_net import address_of, free_endpoint
from vergence import Delivery, DepthResult, DepthSession, NotSent
from vergence_service.app.server import Running

LOSSLESS = Delivery.EVERY


async def step(session: DepthSession, frame_id: int) -> DepthResult:
    frame = make_frame(frame_id)
    return await session.step(frame.left, frame.right, frame.pose, capture_ns=frame.capture_ns)


def submit(session: DepthSession, frame_id: int) -> int | NotSent:
    frame = make_frame(frame_id)
    return session.submit(frame.left, frame.right, frame.pose)


@asynccontextmanager
async def server_on(
    endpoint: str, model: RecallModel | None = None, **flags: Any
) -> AsyncIterator[Running]:
    """A server that joins the router at ``endpoint``."""
    async with running_server(
        model or RecallModel(),
        zenoh__enabled=True,
        zenoh__mode="client",
        zenoh__connect=[endpoint],
        **flags,
    ) as server:
        yield server


@asynccontextmanager
async def lone_server(
    model: RecallModel | None = None, **flags: Any
) -> AsyncIterator[tuple[Running, str]]:
    """A server that is its own router, and its address."""
    endpoint = free_endpoint()
    async with running_server(
        model or RecallModel(), zenoh__enabled=True, zenoh__listen=[endpoint], **flags
    ) as server:
        yield server, address_of(endpoint)


def attached(server: Running, session: DepthSession) -> bool:
    return server.engine.streams.get(session.stream_id).attachment is not None
