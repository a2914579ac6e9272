"""Requests to ``/v1/sequences``, which are repeated while the server is away or has no room."""

import asyncio
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from typing import TYPE_CHECKING, Any, Self

from vergence.transports.addresses import on_this_machine
from vergence.transports.base import ConnectionLost
from vergence.transports.credentials import Credentials
from vergence.transports.proxies import through_proxy
from vergence_proto.errors import UnknownSequence, error_from_wire
from vergence_proto.extras import how_to_install

if TYPE_CHECKING:  # an extra
    import httpx

_CONNECT_S = 10.0
_SILENT_S = 60.0  # a server answers, or sends a byte, within this time
_ASK_EVERY_S = 0.5
_UNPACKING_S = 3600.0  # a server reads all of an upload before it answers
_UNAVAILABLE = {409, 429, 503}  # 409: the request before, whose answer was lost, goes on

Query = Mapping[str, Any]


class Requests:
    """An HTTP client that goes on after lost connections and restarts of the server.

    A request is repeated until ``patience_s`` have passed without a byte from or to the server.
    Then it raises ConnectionLost.
    """

    def __init__(self, server: str, credentials: Credentials, *, patience_s: float) -> None:
        try:
            import httpx
        except ImportError:
            raise ImportError(f"jobs need httpx: {how_to_install('cli')}") from None
        self._server = server
        self._patience_s = patience_s
        self._moved_s = time.monotonic()
        self._lost: type[Exception] = httpx.TransportError
        self._usual = httpx.Timeout(_SILENT_S, connect=_CONNECT_S)
        self._unpacking = httpx.Timeout(_UNPACKING_S, connect=_CONNECT_S)
        try:
            self._http = httpx.AsyncClient(
                base_url=server,
                headers=dict(credentials.headers),
                verify=credentials.tls(),
                timeout=self._usual,
                trust_env=not on_this_machine(server),
            )
        except (ImportError, ValueError) as error:  # a SOCKS proxy without its package, or no URL
            raise ConnectionLost(
                f"no connection to {server}{through_proxy(server)}: {error}"
            ) from None

    async def __aenter__(self) -> Self:
        await self._http.__aenter__()
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        await self._http.aclose()

    def moved(self) -> None:
        """Note that bytes have passed: patience begins again."""
        self._moved_s = time.monotonic()

    async def ask(
        self,
        method: str,
        path: str,
        *,
        query: Query | None = None,
        headers: Mapping[str, str] | None = None,
        body: Callable[[], AsyncIterator[bytes]] | None = None,
        when_full: bool = False,
        unpacking: bool = False,
    ) -> "httpx.Response":
        """Send a request until it is answered. ``when_full``: also until the server has room.

        ``unpacking``: the answer takes as long as the upload is large.

        Raises the class of :mod:`vergence_proto.errors` that the server names, and ConnectionLost.
        """
        while True:
            answer = await self.patiently(
                lambda: self._http.request(
                    method,
                    path,
                    params=query,
                    headers=headers,
                    timeout=self._unpacking if unpacking else self._usual,
                    content=None if body is None else self._counted(body()),
                )
            )
            retry = answer.headers.get("Retry-After")
            if answer.status_code in _UNAVAILABLE and retry is not None and when_full:
                await asyncio.sleep(min(float(retry), _SILENT_S))
                self.moved()
                continue
            return checked(answer)

    async def once(
        self, method: str, path: str, *, headers: Mapping[str, str], body: AsyncIterator[bytes]
    ) -> "httpx.Response":
        """Send a request that must not be repeated as it is. Raises what httpx does."""
        content = self._counted(body)
        return checked(await self._http.request(method, path, headers=headers, content=content))

    async def stream(
        self, path: str, *, query: Query, headers: Mapping[str, str]
    ) -> "AsyncIterator[httpx.Response]":
        """Yield one answer whose body is read by the caller. Raises what httpx does."""
        async with self._http.stream("GET", path, params=query, headers=headers) as answer:
            yield answer

    async def patiently(self, ask: Callable[[], Awaitable[Any]]) -> Any:
        """Repeat ``ask`` while the connection is lost. Raises ConnectionLost."""
        self.moved()  # patience begins with the first attempt
        while True:
            try:
                answer = await ask()
            except self._lost as error:
                if time.monotonic() - self._moved_s > self._patience_s:
                    through = through_proxy(self._server) if self._http.trust_env else ""
                    raise ConnectionLost(
                        f"cannot reach {self._server}{through}: {error or type(error).__name__}"
                    ) from None
            else:
                self.moved()
                return answer
            await asyncio.sleep(_ASK_EVERY_S)

    async def _counted(self, body: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
        async for chunk in body:
            self.moved()
            yield chunk


def checked(answer: "httpx.Response") -> "httpx.Response":
    """Return an answer that is no error. Raises the error that the server names."""
    if not answer.is_error:
        return answer
    head = answer.request.method == "HEAD"  # its answer has no body
    if not head and answer.headers.get("Content-Type") == "application/problem+json":
        problem = answer.json()
        if "reason" in problem:
            raise error_from_wire(problem["reason"], problem["detail"])
    if head and answer.status_code == 404:
        raise UnknownSequence(f"{answer.url.path} is not there, or no longer")
    raise ConnectionLost(f"{answer.url} answered {answer.status_code}: is it a Vergence server?")
