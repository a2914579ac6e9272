"""Compose what protects the server: the gate, the certificate, and the check of addresses."""

import asyncio
import ipaddress
from collections.abc import Iterator

from vergence_service.access.gate import Gate
from vergence_service.access.tokens import TokenFileError, Tokens
from vergence_service.settings import Settings, SettingsError
from vergence_service.streams.engine import DepthEngine
from vergence_service.transports.http.border import HostNames
from vergence_service.transports.tls import BadCertificate, Certificate

_LOOK_EVERY_S = 0.5


def check_exposure(settings: Settings) -> None:
    """Raise SettingsError if strangers could reach the server, unless the settings allow it."""
    chosen = settings.security
    if (chosen.tls_cert is None) != (chosen.tls_key is None):
        raise SettingsError("security.tls_cert and security.tls_key need each other")
    if chosen.client_ca is not None and chosen.tls_cert is None:
        raise SettingsError("security.client_ca needs security.tls_cert and security.tls_key")
    credentials = chosen.tokens is not None or chosen.client_ca is not None
    if chosen.insecure:
        return
    if credentials and settings.zenoh.enabled and settings.zenoh.config is None:
        raise SettingsError(
            "over Zenoh, users are checked by its own configuration: set zenoh.config to a file of "
            "vergence zenoh-config, or start the server with --insecure"
        )
    exposed = list(_open_zenoh(settings))
    if chosen.tls_cert is None or not credentials:
        exposed += [
            each or settings.server.host for each in (settings.grpc.host, settings.http.host)
        ]
    if chosen.tls_cert is None or chosen.tokens is None:
        exposed.append(settings.admin.host)
    for host in exposed:
        if not is_loopback(host):
            raise SettingsError(
                f"the server would serve {host} without TLS and credentials; set "
                "security.tls_cert, security.tls_key and security.tokens (vergence token add NAME)"
                + (", and zenoh.config (vergence zenoh-config)" if settings.zenoh.enabled else "")
                + ", or, on a network that you trust, start it with --insecure"
            )


def make_gate(settings: Settings) -> Gate:
    """Read the tokens. Raises SettingsError."""
    chosen = settings.security
    try:
        tokens = None if chosen.tokens is None else Tokens(chosen.tokens)
    except TokenFileError as error:
        raise SettingsError(str(error)) from None
    return Gate(
        tokens,
        certificates=chosen.client_ca is not None,
        most_requests=settings.limits.requests,
    )


def make_certificate(settings: Settings) -> Certificate | None:
    """Read the certificate, if there is one. Raises SettingsError."""
    chosen = settings.security
    if chosen.tls_cert is None or chosen.tls_key is None:
        return None
    try:
        return Certificate(chosen.tls_cert, chosen.tls_key, chosen.client_ca)
    except BadCertificate as error:
        raise SettingsError(str(error)) from None


def host_names(settings: Settings) -> HostNames:
    """Return the names under which the server may be called over HTTP."""
    chosen = settings.security
    names = tuple(name.lower() for name in chosen.hosts)
    origins = tuple(origin.lower().rstrip("/") for origin in chosen.origins)
    return HostNames(names=names, origins=origins, certified=chosen.tls_cert is not None)


async def keep_current(gate: Gate, certificate: Certificate | None, engine: DepthEngine) -> None:
    """Read tokens and certificate again when they change; end the streams of removed tokens."""
    while True:
        await asyncio.sleep(_LOOK_EVERY_S)
        if certificate is not None:
            certificate.reload()
        if gate.tokens is not None and gate.tokens.reload():
            engine.streams.end_those_of(lambda owner: not gate.valid(owner.name, owner.credential))


def is_loopback(host: str) -> bool:
    """Return True if only this machine can reach the address."""
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"


def _open_zenoh(settings: Settings) -> Iterator[str]:
    """Yield the addresses on which Zenoh serves without a configuration of its own."""
    chosen = settings.zenoh
    if not chosen.enabled or chosen.config is not None:
        return
    if chosen.mode == "router" and not chosen.listen:
        yield chosen.host or settings.server.host
    for endpoint in chosen.listen:
        address = endpoint.partition("/")[2].partition("?")[0].partition("#")[0]
        host = address.rpartition(":")[0].strip("[]")
        if not endpoint.startswith("unix"):
            yield host or address
