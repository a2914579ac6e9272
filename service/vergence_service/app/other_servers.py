"""The servers behind the same front, as the settings have them."""

import socket

from starlette.types import ASGIApp

from vergence_service.jobs.queue import JobQueue
from vergence_service.settings import Settings
from vergence_service.transports.errors import ExtraMissing
from vergence_service.transports.http.other_servers import OtherServers

_REDIS_S = 1.0  # no frame waits for it


def with_other_servers(
    app: ASGIApp, queue: JobQueue, settings: Settings, *, port: int
) -> OtherServers | None:
    """Make an application that passes requests on; None: there are no others.

    Raises ExtraMissing.
    """
    batch = settings.batch
    if batch.servers == "none":
        return None
    try:
        from vergence_service.jobs.redis_directory import RedisDirectory
    except ModuleNotFoundError:
        raise ExtraMissing("Redis", "fleet") from None
    directory = RedisDirectory(batch.servers, keep_s=batch.keep_h * 3600, timeout_s=_REDIS_S)
    address = batch.address or _own_address(settings, port)
    return OtherServers(app, queue, directory=directory, address=address)


def _own_address(settings: Settings, port: int) -> str:
    """Return what containers and pods are reached by: the address of their host name."""
    scheme = "http" if settings.security.tls_cert is None else "https"
    try:
        host = socket.gethostbyname(socket.gethostname())
    except OSError:
        host = "127.0.0.1"
    return f"{scheme}://{host}:{port}"
