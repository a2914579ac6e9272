"""A session whose connection runs through a proxy, and the events that it reports."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from tests.support.frames import RIG
from tests.support.models import RecallModel
from tests.support.polling import eventually
from tests.support.proxy import Proxy, proxy_to
from tests.support.server import ManualClock, running_server
from tests.support.session_frames import EXACT
from vergence import Delivery, DepthClient, DepthSession, EventKind, SessionEvent


class Scene:
    def __init__(self, model: RecallModel, proxy: Proxy, client: DepthClient) -> None:
        self.model = model
        self.proxy = proxy
        self.client = client
        self.events: list[SessionEvent] = []

    def open_session(self, delivery: Delivery = Delivery.NEWEST, **choices: Any) -> DepthSession:
        return self.client.open_session(
            RIG, delivery=delivery, output=EXACT, on_event=self.events.append, **choices
        )

    @property
    def kinds(self) -> list[EventKind]:
        return [event.kind for event in self.events]

    async def until(self, kind: EventKind) -> None:
        await eventually(lambda: kind in self.kinds)


@asynccontextmanager
async def scene(*, clock: ManualClock | None = None, **flags: Any) -> AsyncIterator[Scene]:
    model = RecallModel()
    async with (
        running_server(model, clock=clock, **flags) as server,
        proxy_to(server.grpc_address) as proxy,
        DepthClient(proxy.address) as client,
    ):
        yield Scene(model, proxy, client)
