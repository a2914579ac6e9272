"""A session opens whatever the round trip, over every transport."""

import asyncio

from tests.support.frames import RIG
from tests.support.models import RecallModel
from tests.support.proxy import proxy_to
from tests.support.session_frames import step
from tests.support.zenoh_sessions import lone_server
from vergence import DepthClient


async def opens(transport: str, address: str, round_trip_s: float) -> None:
    async with (
        proxy_to(address, delay_s=round_trip_s / 2) as proxy,
        DepthClient(f"{transport}://{proxy.address}") as client,
        client.open_session(RIG) as session,
    ):
        assert (await step(session, 1)).step_count == 1


async def test_a_session_opens_at_any_round_trip() -> None:
    async with lone_server(RecallModel()) as (server, zenoh_address):
        addresses = {
            "grpc": server.grpc_address,
            "http": server.http_address,
            "zenoh": zenoh_address.removeprefix("zenoh://"),
        }
        await asyncio.gather(
            *(
                opens(transport, address, round_trip_s)
                for transport, address in addresses.items()
                for round_trip_s in (0.06, 0.15, 0.3)
            )
        )
