"""The servers behind the same front, as the settings have them."""

import socket

from starlette.types import ASGIApp

from vergence_service.app.security import is_loopback
from vergence_service.jobs.queue import JobQueue
from vergence_service.settings import Settings, SettingsError
from vergence_service.transports.errors import ExtraMissing
from vergence_service.transports.http.other_servers import OtherServers

_REDIS_S = 1.0  # no frame waits for it


def with_other_servers(
    app: ASGIApp, queue: JobQueue, settings: Settings, *, host: str, port: int
) -> OtherServers | None:
    """Make an application that passes requests on; None: there are no others.

    Raises ExtraMissing, and SettingsError: it is not known how the others reach this server.
    """
    batch = settings.batch
    if batch.servers == "none":
        return None
    try:
        from vergence_service.jobs.redis_directory import RedisDirectory
    except ModuleNotFoundError:
        raise ExtraMissing("Redis", "fleet") from None
    directory = RedisDirectory(batch.servers, keep_s=batch.keep_h * 3600, timeout_s=_REDIS_S)
    address = batch.address or _address_of(host, port, tls=settings.security.tls_cert is not None)
    return OtherServers(app, queue, directory=directory, address=address)


def _address_of(host: str, port: int, *, tls: bool) -> str:
    """Return the URL of a server that listens on ``host``.

    That of all interfaces is the address of the host's name, as containers and pods have it.
    """
    if tls:
        raise SettingsError(
            "batch.servers with TLS needs batch.address: https:// and a name of the certificate"
        )
    if host in ("0.0.0.0", "::"):
        host = _address_of_this_host()
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def _address_of_this_host() -> str:
    name = socket.gethostname()
    try:
        address = socket.gethostbyname(name)
    except OSError:
        address = "127.0.0.1"
    if is_loopback(address):
        raise SettingsError(
            f"batch.servers needs batch.address: other machines do not reach {name} at {address}"
        )
    return address
