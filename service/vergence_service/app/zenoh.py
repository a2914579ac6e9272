"""Compose the Zenoh transport, if the settings enable it."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from vergence_service.access.gate import Gate
from vergence_service.settings import Settings
from vergence_service.transports.addresses import format_address
from vergence_service.transports.errors import ExtraMissing
from vergence_service.transports.open_calls import OpenCalls
from vergence_service.transports.unary import UnaryMethods

if TYPE_CHECKING:  # Zenoh is an optional extra
    from vergence_service.transports.zenoh.server import ZenohServer

_ROUTER_PORT = 7447  # Zenoh's default port


@dataclass(frozen=True, slots=True, eq=False)
class ZenohTransport:
    """The Zenoh server while it runs."""

    server: "ZenohServer"
    endpoint: str  # the endpoint for clients, or the file that configures it


@asynccontextmanager
async def serving_zenoh(
    settings: Settings, unary: UnaryMethods, calls: OpenCalls, gate: Gate
) -> AsyncIterator[ZenohTransport | None]:
    """Serve over Zenoh until the end of the block, or yield None if it is not enabled.

    Raises ExtraMissing if Zenoh is not installed, and ZenohUnreachable if the network cannot be
    joined.
    """
    chosen = settings.zenoh
    if not chosen.enabled:
        yield None
        return
    try:
        from vergence_service.transports.zenoh.server import ZenohServer, zenoh_config
    except ImportError:
        raise ExtraMissing("Zenoh", "zenoh") from None
    listen = list(chosen.listen)
    if chosen.mode == "router" and not listen:
        host = chosen.host or settings.server.host
        listen = [f"tcp/{format_address(host, _ROUTER_PORT)}"]
    config = zenoh_config(
        chosen.config,
        mode=chosen.mode,
        listen=listen,
        connect=chosen.connect,
        shared_memory=chosen.shared_memory,
        max_frame_bytes=calls.limits.max_frame_bytes,
        namespace=chosen.namespace,
    )
    endpoint = str(chosen.config or ",".join(listen or chosen.connect))
    async with ZenohServer(
        unary, calls, gate=gate, config=config, namespace=chosen.namespace
    ) as server:
        yield ZenohTransport(server, endpoint)
