"""HTTP for those who look after the server: is it alive, is it ready, what does it count."""

import asyncio
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Self

import uvicorn
from fastapi import FastAPI, Response
from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, generate_latest

from vergence_service.transports import PortTaken


def make_http_app(*, ready: Callable[[], bool], registry: CollectorRegistry) -> FastAPI:
    app = FastAPI(title="Vergence", docs_url=None, redoc_url=None)

    @app.get("/healthz")
    async def alive() -> dict[str, str]:
        """The process answers."""
        return {"status": "alive"}

    @app.get("/readyz")
    async def readiness(response: Response) -> dict[str, str]:
        """New streams are taken: 503 while the model loads and while the server drains."""
        if not ready():
            response.status_code = 503
        return {"status": "ready" if ready() else "not ready"}

    @app.get("/metrics")
    async def metrics() -> Response:
        return Response(generate_latest(registry), media_type=CONTENT_TYPE_LATEST)

    return app


class _Uvicorn(uvicorn.Server):
    """Leaves the signals to whoever runs the process."""

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


class HttpServer:
    """Serves the app from the start of its context to its end. Raises PortTaken."""

    def __init__(self, app: FastAPI, *, host: str, port: int) -> None:
        self._app = app
        self._address = (host, port)
        self.port = port

    async def __aenter__(self) -> Self:
        family = socket.AF_INET6 if ":" in self._address[0] else socket.AF_INET
        try:
            self._socket = socket.create_server(self._address, family=family)
        except OSError:
            raise PortTaken("{}:{}".format(*self._address), "http.port") from None
        self.port = self._socket.getsockname()[1]
        config = uvicorn.Config(self._app, log_config=None, access_log=False, lifespan="off")
        self._server = _Uvicorn(config)
        self._task = asyncio.create_task(self._server.serve([self._socket]), name="http")
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        self._server.should_exit = True
        await self._task
        self._socket.close()
