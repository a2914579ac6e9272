"""The HTTP application and its server: sequences, pairs, streams and health."""

import asyncio
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any, Self

import uvicorn
from fastapi import APIRouter, FastAPI, Response
from fastapi.openapi.utils import get_openapi
from pydantic.json_schema import models_json_schema
from starlette.types import ASGIApp

from vergence_service.transports.http.connections import BoundedConnection, ConnectionLimits
from vergence_service.transports.http.errors import Problem, install_problems
from vergence_service.transports.http.uploads import SequenceForm
from vergence_service.transports.open_calls import FINISHING_SHARE, OpenCalls
from vergence_service.transports.tls import Certificate

_ABOUT = """Disparity of whole stereo sequences, as a job, and of single pairs.

Live streams use gRPC (`vergence.v1.DepthService`). An error is answered with problem details
(RFC 9457); `reason` is the same code as over gRPC.
"""
# Time to finish the answers that are being sent when the server stops.
_FINISH_S = 5
_BACKLOG = 64


def make_http_app(
    *,
    version: str,
    ready: Callable[[], bool],
    routes: Sequence[APIRouter],
) -> FastAPI:
    """Make the application from its routes."""
    app = FastAPI(
        title="Vergence", version=version, description=_ABOUT, docs_url=None, redoc_url=None
    )
    app.openapi = lambda: _openapi(app)  # type: ignore[method-assign] # as FastAPI documents it
    install_problems(app)
    for router in (_health_routes(ready), *routes):
        app.include_router(router)
    return app


def _health_routes(ready: Callable[[], bool]) -> APIRouter:
    router = APIRouter(tags=["health"])

    @router.get("/healthz")
    async def alive() -> dict[str, str]:
        """Check that the process answers."""
        return {"status": "alive"}

    @router.get("/readyz", responses={503: {"description": "New streams are not accepted"}})
    async def readiness(response: Response) -> dict[str, str]:
        """Check for readiness: 503 while the model loads and while the server drains."""
        if not ready():
            response.status_code = 503
        return {"status": "ready" if ready() else "not ready"}

    return router


def _openapi(app: FastAPI) -> dict[str, Any]:
    """Return FastAPI's schema, with the schemas of problems and forms that it does not find."""
    if app.openapi_schema is None:
        schema = get_openapi(
            title=app.title, version=app.version, description=app.description, routes=app.routes
        )
        _, found = models_json_schema(
            [(Problem, "serialization"), (SequenceForm, "validation")],
            ref_template="#/components/schemas/{model}",
        )
        schema.setdefault("components", {}).setdefault("schemas", {}).update(found["$defs"])
        app.openapi_schema = schema
    return app.openapi_schema


class _Uvicorn(uvicorn.Server):
    """A uvicorn server that ends when it is told to. Signals are left to the process."""

    def __init__(self, config: uvicorn.Config) -> None:
        super().__init__(config)
        self._told = asyncio.Event()

    def end(self, *, within_s: float) -> None:
        self.config.timeout_graceful_shutdown = within_s  # type: ignore[assignment] # takes fractions
        self.should_exit = True
        self._told.set()

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield

    async def main_loop(self) -> None:
        # uvicorn's own looks ten times a second whether it should end.
        while not await self.on_tick(0):  # 0: it renews the header `date`
            with suppress(TimeoutError):
                await asyncio.wait_for(self._told.wait(), 1.0)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        for server in self.servers:
            server.close()
        await asyncio.sleep(0)  # for connections that were just accepted
        # uvicorn's own waits a tenth of a second even if there are none.
        if self.server_state.connections or self.server_state.tasks:
            await super().shutdown(sockets)
        for listening in sockets or []:
            listening.close()


class HttpServer:
    """Serves the app as long as its context lasts.

    At the end, it sets ``stopping``, ends ``calls``, if it has any, and waits for the answers that
    are being sent.
    """

    def __init__(
        self,
        app: ASGIApp,
        calls: OpenCalls | None,
        *,
        listening: socket.socket,
        limits: ConnectionLimits,
        stopping: asyncio.Event,
        certificate: Certificate | None = None,
        trusted_proxies: Sequence[str] = (),
    ) -> None:
        self._certificate = certificate
        self._trusted_proxies = list(trusted_proxies)
        self._app = app
        self._limits = limits
        self._calls = calls
        self._socket = listening
        self._stopping = stopping
        self.port: int = listening.getsockname()[1]

    async def __aenter__(self) -> Self:
        config = uvicorn.Config(
            self._app,
            http=partial(BoundedConnection, self._limits),  # type: ignore[arg-type] # makes a class's instance
            # asyncio accepts so many connections before it looks at the first of them.
            backlog=min(_BACKLOG, self._limits.connections),
            log_config=None,
            access_log=False,
            lifespan="off",
            proxy_headers=bool(self._trusted_proxies),
            forwarded_allow_ips=self._trusted_proxies,
        )
        if self._certificate is not None:
            config.load()
            config.ssl = self._certificate.context
        self._server = _Uvicorn(config)
        self._task = asyncio.create_task(self._server.serve([self._socket]), name="http")
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        if self._calls is not None:
            await self._calls.drain(within_s=0)
        await self._finish(within_s=_FINISH_S)

    async def drain(self, *, within_s: float) -> None:
        """Wait until all calls end; after ``within_s``, answer what they have sent and end them."""
        if self._calls is not None:
            await self._calls.drain(within_s=within_s)
        await self._finish(within_s=FINISHING_SHARE * within_s)

    async def _finish(self, *, within_s: float) -> None:
        """Accept no more requests, and wait for the answers that are being sent."""
        self._stopping.set()
        self._server.end(within_s=within_s)
        await self._task
