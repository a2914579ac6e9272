"""The administrator's listener: metrics, open streams, the page that shows them, and the docs."""

import html
import secrets
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Annotated, Any
from urllib.parse import parse_qs

from fastapi import APIRouter, FastAPI, Query, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse
from prometheus_client import CollectorRegistry

from vergence_proto.errors import DepthError, Unauthenticated
from vergence_service.access.gate import Gate
from vergence_service.access.principals import Principal, Role
from vergence_service.jobs.registry import JobRegistry
from vergence_service.streams.engine import DepthEngine
from vergence_service.streams.report import ServerReport, StreamReport, reports, server_report
from vergence_service.transports.callers import CALLER
from vergence_service.transports.http.errors import PROBLEM_RESPONSE, install_problems
from vergence_service.transports.http.metrics import metrics_routes
from vergence_service.transports.http.result_download import ResultDownloads
from vergence_service.transports.http.sequence_models import ResultQuery

COOKIE = "vergence_admin"
LOGIN = "/login"
_COOKIE_LIFE_S = 12 * 3600
_MOST_LOGINS = 1000
_LARGEST_FORM = 4096
_MOST_SEQUENCES = 20
# The page and the docs are files of this package: nothing is loaded from elsewhere.
_ASSETS = {
    "page.js": "text/javascript",
    "view.js": "text/javascript",
    "depth.js": "text/javascript",
    "page.css": "text/css",
}
_POLICY = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "connect-src 'self'; img-src 'self' data:; form-action 'self'; base-uri 'none'; "
    "frame-ancestors 'none'"
}


@dataclass(frozen=True, slots=True)
class SequenceReport:
    """A job: one sequence that was submitted."""

    job_id: str  # empty for callers without a credential, since it is the job's secret
    principal: str
    name: str
    state: str
    frames: int
    frames_done: int
    frames_failed: int
    eta_s: float | None
    message: str | None


@dataclass(frozen=True, slots=True)
class AdminState:
    """What the page shows."""

    server: ServerReport
    streams: list[StreamReport]
    sequences: list[SequenceReport]  # the newest ones
    logged_in: bool  # False: the server asks for no credential


class Logins:
    """The browsers that have shown an administrator's token. Each has a cookie with a secret."""

    def __init__(self, gate: Gate) -> None:
        self._gate = gate
        self._by_secret: dict[str, tuple[Principal, float]] = {}

    def add(self, token: str) -> str:
        """Return the secret of a new cookie. Raises Unauthenticated or Forbidden."""
        principal = self._gate.caller(f"Bearer {token}")
        principal.check_admin()
        while len(self._by_secret) >= _MOST_LOGINS:
            del self._by_secret[next(iter(self._by_secret))]
        secret = secrets.token_urlsafe(32)
        self._by_secret[secret] = principal, time.monotonic() + _COOKIE_LIFE_S
        return secret

    def caller(self, authorization: str | None, cookies: Mapping[str, str]) -> Principal:
        """Return who calls, by a token or by a cookie.

        Raises Unauthenticated or Forbidden if it is no administrator. A server without credentials
        lets everybody on this machine be one.
        """
        principal = self._of_cookie(cookies.get(COOKIE, "")) if authorization is None else None
        principal = principal or self._gate.caller(authorization)
        if not self._gate.open:
            principal.check_admin()
        return principal

    def forget(self, cookies: Mapping[str, str]) -> None:
        """End a login."""
        self._by_secret.pop(cookies.get(COOKIE, ""), None)

    def _of_cookie(self, secret: str) -> Principal | None:
        principal, until_s = self._by_secret.get(secret, (None, 0.0))
        if principal is None or time.monotonic() > until_s:
            return None
        if not self._gate.valid(principal.name, principal.credential):
            raise Unauthenticated("the token of this login was removed")
        return principal


def make_admin_app(
    engine: DepthEngine,
    registry: CollectorRegistry,
    logins: Logins,
    *,
    jobs: JobRegistry | None,
    routes: Sequence[APIRouter],
    public_schema: Callable[[], dict[str, Any]],
    clock: Callable[[], float],
    secure: bool,
) -> FastAPI:
    """Make the application.

    ``routes`` are those that the page uses besides its own; ``public_schema`` is that of the HTTP
    API; ``secure``: over TLS.
    """
    app = FastAPI(title="Vergence, administration", docs_url=None, redoc_url=None)
    install_problems(app)
    app.include_router(metrics_routes(registry))
    router = APIRouter(responses=PROBLEM_RESPONSE)

    @router.get("/healthz")
    async def alive() -> dict[str, str]:
        """Check that the process answers."""
        return {"status": "alive"}

    @router.get("/v1/admin/streams")
    async def streams() -> list[StreamReport]:
        """List the open streams of all principals, those with the most model time first."""
        return reports(engine.streams, clock())

    @router.get("/v1/admin/state")
    async def state() -> AdminState:
        """Get all that the page shows: the server, and its open streams."""
        now_s = clock()
        caller = CALLER.get()
        return AdminState(
            server_report(engine, now_s),
            reports(engine.streams, now_s),
            _sequences(jobs, caller) if jobs is not None else [],
            logged_in=caller.proven,
        )

    @router.delete("/v1/admin/streams/{principal}/{stream_id}", status_code=204)
    async def close(principal: str, stream_id: str) -> None:
        """End a stream. It needs the token of an administrator, also on this machine."""
        if CALLER.get().role is not Role.ADMIN:
            raise Unauthenticated("closing the stream of another needs an administrator's token")
        await engine.close(stream_id, owner=principal)

    @router.get("/docs", response_class=HTMLResponse)
    async def docs() -> HTMLResponse:
        """Show the operations of the HTTP API."""
        return _page("HTTP API", _operations(public_schema()))

    @router.get("/openapi.json")
    async def schema() -> dict[str, Any]:
        """Get the schema of the HTTP API."""
        return public_schema()

    @router.get("/", response_class=HTMLResponse)
    async def page() -> HTMLResponse:
        """Show the open streams and the jobs, live."""
        return HTMLResponse(_asset("page.html"), headers=_POLICY)

    @router.get("/view", response_class=HTMLResponse)
    async def view() -> HTMLResponse:
        """Show the depth of a stream, live, or of two images that are dropped there."""
        return HTMLResponse(_asset("view.html"), headers=_POLICY)

    @router.get("/assets/{name}")
    async def asset(name: str) -> Response:
        """Get a file of a page."""
        if name not in _ASSETS:
            return Response(status_code=404)
        return Response(_asset(name), media_type=_ASSETS[name])

    @router.get(LOGIN, response_class=HTMLResponse)
    async def form() -> HTMLResponse:
        """Show the form that asks for a token."""
        return _page("Log in", _FORM)

    @router.post(LOGIN)
    async def log_in(request: Request) -> Response:
        """Set a cookie, in exchange for the token of an administrator."""
        body = bytearray()
        async for chunk in request.stream():
            body += chunk
            if len(body) > _LARGEST_FORM:
                return Response(status_code=413)
        token = parse_qs(body.decode("utf-8", "replace")).get("token", [""])[0].strip()
        try:
            secret = logins.add(token)
        except DepthError as error:
            refused = _page("Log in", f"<p>{html.escape(str(error))}</p>{_FORM}")
            refused.status_code = 401
            return refused
        answer = RedirectResponse("/", status_code=303)
        answer.set_cookie(
            COOKIE,
            secret,
            max_age=_COOKIE_LIFE_S,
            httponly=True,
            samesite="strict",
            secure=secure,
        )
        return answer

    @router.post("/logout")
    async def log_out(request: Request) -> Response:
        """End the login of this browser."""
        logins.forget(request.cookies)
        answer = RedirectResponse(LOGIN, status_code=303)
        answer.delete_cookie(COOKIE)
        return answer

    if jobs is not None:
        downloads = ResultDownloads(jobs, engine.threads.background)

        @router.get("/v1/admin/sequences/{job_id}/result", response_class=Response)
        async def result(
            request: Request, job_id: str, query: Annotated[ResultQuery, Query()]
        ) -> Response:
            """Download the result of a job."""
            jobs.check_owner(job_id, CALLER.get())
            return await downloads.answer(request, job_id, query.format)

    for each in (router, *routes):
        app.include_router(each)
    return app


_FORM = (
    '<form method="post" action="/login"><label>Token of an administrator '
    '<input type="password" name="token" autocomplete="off" required autofocus></label> '
    "<button>Log in</button></form>"
)


def _sequences(jobs: JobRegistry, caller: Principal) -> list[SequenceReport]:
    newest, _ = jobs.page(lambda job: True, size=_MOST_SEQUENCES)
    return [
        SequenceReport(
            job_id=status.job.job_id if caller.proven else "",
            principal=status.job.owner,
            name=status.job.name or status.job.source.rstrip(":"),
            state=status.job.state,
            frames=status.job.frames,
            frames_done=status.frames_done,
            frames_failed=status.job.frames_failed,
            eta_s=status.eta_s,
            message=status.job.message,
        )
        for status in newest
    ]


def _asset(name: str) -> str:
    return files("vergence_service.transports.http").joinpath("assets", name).read_text("utf-8")


def _page(title: str, body: str) -> HTMLResponse:
    return HTMLResponse(
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title>'
        '<link rel="icon" href="data:,"><link rel="stylesheet" href="/assets/page.css">'
        f"<h1>{title}</h1>{body}</html>",
        headers=_POLICY,
    )


def _operations(schema: Mapping[str, Any]) -> str:
    rows = []
    for path, operations in schema["paths"].items():
        for method, operation in operations.items():
            text = html.escape(operation.get("description") or operation.get("summary", ""))
            inputs = ", ".join(each["name"] for each in operation.get("parameters", ()))
            rows.append(
                f"<tr><td><code>{method.upper()} {html.escape(path)}</code><td>{text}"
                f"<td><code>{html.escape(inputs)}</code>"
            )
    return (
        "<table><tr><th>operation<th>what it does<th>parameters"
        + "".join(rows)
        + '</table><p>The whole schema: <a href="/openapi.json">openapi.json</a></p>'
    )
