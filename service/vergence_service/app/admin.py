"""Compose the administrator's listener."""

import asyncio
import errno
import logging
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace

from prometheus_client import CollectorRegistry

from vergence_service.access.gate import Gate
from vergence_service.app.http import HttpTransport
from vergence_service.app.security import host_names
from vergence_service.settings import Settings
from vergence_service.streams.engine import DepthEngine
from vergence_service.transports.addresses import listening_socket
from vergence_service.transports.errors import PortTaken
from vergence_service.transports.http.admin import Logins, make_admin_app
from vergence_service.transports.http.app import HttpServer
from vergence_service.transports.http.border import Border
from vergence_service.transports.http.connections import ConnectionLimits
from vergence_service.transports.http.viewing import viewing_routes
from vergence_service.transports.tls import Certificate

log = logging.getLogger(__name__)

_PORT = 8001
_CONNECTIONS = 32


@asynccontextmanager
async def serving_admin(
    settings: Settings,
    engine: DepthEngine,
    registry: CollectorRegistry,
    gate: Gate,
    certificate: Certificate | None,
    *,
    http: HttpTransport,
    clock: Callable[[], float],
) -> AsyncIterator[HttpServer]:
    """Serve metrics, the page and the administrator's calls until the end of the block.

    The page uses what ``http`` serves. Raises PortTaken if the server cannot listen there.
    """
    limits = settings.limits
    with _listening(settings) as listening:
        logins = Logins(gate)
        app = make_admin_app(
            engine,
            registry,
            logins,
            jobs=None if http.jobs is None else http.jobs.jobs,
            routes=[viewing_routes(engine, images=settings.admin.images), http.pairs],
            public_schema=http.schema,
            clock=clock,
            secure=certificate is not None,
        )
        server = HttpServer(
            Border(app, gate=gate, hosts=replace(host_names(settings), origins=()), logins=logins),
            None,
            listening=listening,
            limits=ConnectionLimits(
                connections=_CONNECTIONS,
                headers_s=limits.first_message_s,
                write_s=limits.write_s,
                min_bytes_per_s=limits.min_kib_per_s * 1024,
            ),
            stopping=asyncio.Event(),
            certificate=certificate,
        )
        async with server:
            yield server


def _listening(settings: Settings) -> socket.socket:
    """Listen on the port of the settings; by default on 8001, or a free port if that is taken."""
    host, port = settings.admin.host, settings.admin.port
    if port is not None:
        return listening_socket(host, port, transport="admin")
    try:
        return listening_socket(host, _PORT, transport="admin")
    except PortTaken as error:
        if error.errno != errno.EADDRINUSE:
            raise
        log.info("another program uses port %d; the metrics are on a free port", _PORT)
        return listening_socket(host, 0, transport="admin")
