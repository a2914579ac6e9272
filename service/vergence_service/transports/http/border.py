"""What every HTTP request must pass: the names of hosts and pages, content types, and the gate.

A browser sends requests to this server for any page that is open in it. A page cannot add a header
or read an answer, but it can submit forms. A page whose name resolves to this machine (DNS
rebinding) can read answers too. So requests that name a foreign host or page are refused.
"""

import ipaddress
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import cookie_parser
from starlette.responses import RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from vergence_proto.errors import BadShape, DepthError, Forbidden
from vergence_proto.http_records import PROTOBUF_TYPE, RECORDS_TYPE
from vergence_service.access.gate import Gate
from vergence_service.transports.callers import CALLER, TRACE_PARENT, trace_parent_of
from vergence_service.transports.http.admin import LOGIN, Logins
from vergence_service.transports.http.errors import refusal_of

# Probes ask for these by any name and without a credential.
_OPEN_PATHS = {"/healthz", "/readyz"}
_LOGIN_PATHS = {LOGIN, "/assets/page.css"}
_PROTOBUF_PATHS = ("/v1/streams", "/v1/methods/")
_CALL_PATHS = "/v1/streams/"
_HEADERS: Mapping[str, str] = {
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    # With "no-referrer", a browser hides the origin of its own forms too, so no login would work.
    "Referrer-Policy": "same-origin",
}
_FOR_PAGES: Mapping[str, str] = {
    "Access-Control-Allow-Methods": "GET, POST, PUT, PATCH, DELETE, HEAD",
    "Access-Control-Allow-Headers": "*, Authorization",
    "Access-Control-Expose-Headers": "*",
    "Access-Control-Max-Age": "600",
    "Cross-Origin-Resource-Policy": "cross-origin",
    "Vary": "Origin",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class HostNames:
    """The names under which a server may be called.

    An address needs no entry, since only a name can be made to resolve to another machine.
    """

    names: Sequence[str] = ()  # besides localhost; "*": any
    origins: Sequence[str] = ()  # of pages that may call
    certified: bool = False  # TLS proves the name: a browser refuses a foreign one

    def check_host(self, host: str) -> None:
        """Raise Forbidden unless ``host``, the header of this name, is one of them."""
        name = _name_of(host)
        if self.certified or "*" in self.names or name in self.names or _is_plain(name):
            return
        raise Forbidden(
            f"this server does not answer to the name {name[:100]!r}; call it by its address, or "
            "add the name to the server's setting security.hosts"
        )

    def invites(self, headers: Headers) -> bool:
        """Return True if a page of one of the origins sent the request."""
        return headers.get("origin", "").lower() in self.origins

    def check_page(self, headers: Headers) -> None:
        """Raise Forbidden if a page of another origin sent the request."""
        origin = headers.get("origin")
        if self.invites(headers):
            return
        if origin is not None:
            parts = urlsplit(origin)
            same = parts.netloc.lower() == headers.get("host", "").lower()
            if not same and _name_of(parts.netloc) not in self.names:
                raise Forbidden("requests of web pages of another origin are not answered")
        if headers.get("sec-fetch-site", "none") not in ("none", "same-origin"):
            raise Forbidden("requests of web pages of another site are not answered")


class Border:
    """An ASGI application that lets only allowed requests pass to another one."""

    def __init__(
        self, app: ASGIApp, *, gate: Gate, hosts: HostNames, logins: Logins | None = None
    ) -> None:
        self._app = app
        self._gate = gate
        self._hosts = hosts
        self._logins = logins  # for the administrator's listener

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or refuse it with problem details."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        asked = Headers(scope=scope)
        invited = self._hosts.invites(asked)
        preflight = invited and "access-control-request-method" in asked

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                if invited:
                    headers.update({**_FOR_PAGES, "Access-Control-Allow-Origin": asked["origin"]})
                for name, value in _HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        with ExitStack() as stack:
            try:
                if preflight:  # a browser asks without the page's credential
                    self._hosts.check_host(asked.get("host", ""))
                elif scope["path"] not in _OPEN_PATHS:
                    self._check(scope, stack)
            except DepthError as error:
                answer: Response = refusal_of(error)
                if self._logins is not None and _is_browser(scope):
                    answer = RedirectResponse(LOGIN, status_code=303)
                await answer(scope, receive, send_with_headers)
            else:
                app = Response(status_code=204) if preflight else self._app
                await app(scope, receive, send_with_headers)

    def _check(self, scope: Scope, request: ExitStack) -> None:
        headers = Headers(scope=scope)
        self._hosts.check_host(headers.get("host", ""))
        self._hosts.check_page(headers)
        authorization = headers.get("authorization")
        if self._logins is not None:
            if scope["path"] not in _LOGIN_PATHS:
                cookies = cookie_parser(headers.get("cookie", ""))
                CALLER.set(self._logins.caller(authorization, cookies))
            return
        names = scope.get("state", {}).get("certificate_names", ())
        caller = self._gate.caller(authorization, names)
        request.enter_context(self._gate.requests.of(caller))
        CALLER.set(caller)
        TRACE_PARENT.set(trace_parent_of(headers.get("traceparent")))
        if scope["method"] == "POST" and scope["path"].startswith(_PROTOBUF_PATHS):
            kind = headers.get("content-type", "").partition(";")[0].strip().lower()
            call = scope["path"].startswith(_CALL_PATHS)
            if kind != PROTOBUF_TYPE and not (call and kind == RECORDS_TYPE):
                raise BadShape(f"expected a body of {PROTOBUF_TYPE}, got {kind[:100]!r}")


def _is_browser(scope: Scope) -> bool:
    """Return True for a page that a person asks for."""
    return scope["method"] == "GET" and "text/html" in Headers(scope=scope).get("accept", "")


def _name_of(host: str) -> str:
    """Return the host without its port, in lower case."""
    name, colon, port = host.strip().lower().rpartition(":")
    if not colon or not port.isdecimal():
        name = host.strip().lower()
    return name.strip("[]").removesuffix(".")


def _is_plain(name: str) -> bool:
    """Return True for an address and for names that always mean this machine (RFC 6761)."""
    if name == "localhost" or name.endswith(".localhost"):
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
