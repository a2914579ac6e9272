"""Compose the HTTP transport: the jobs on disk, the routes and their server."""

import asyncio
import logging
import os
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import AsyncExitStack, ExitStack, asynccontextmanager, contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from fastapi import APIRouter
from prometheus_client import CollectorRegistry
from starlette.types import ASGIApp

from vergence_service.access.gate import Gate
from vergence_service.app.other_servers import with_other_servers
from vergence_service.app.security import host_names, is_loopback
from vergence_service.jobs.archive_limits import ArchiveLimits
from vergence_service.jobs.places import Places
from vergence_service.jobs.queue import JobQueue, QueueLimits
from vergence_service.jobs.storage import free_bytes
from vergence_service.jobs.store import JobStore, StoreInUse, StoreUnavailable
from vergence_service.settings import Settings
from vergence_service.streams.engine import DepthEngine
from vergence_service.transports.addresses import listening_socket
from vergence_service.transports.http.app import HttpServer, make_http_app
from vergence_service.transports.http.border import Border
from vergence_service.transports.http.connections import ConnectionLimits
from vergence_service.transports.http.inference_protocol import inference_routes
from vergence_service.transports.http.metrics import metrics_routes
from vergence_service.transports.http.pairs import pair_routes
from vergence_service.transports.http.sequences import no_sequence_routes, sequence_routes
from vergence_service.transports.http.streams import stream_routes
from vergence_service.transports.http.uploads import UploadLimits
from vergence_service.transports.open_calls import OpenCalls
from vergence_service.transports.tls import Certificate
from vergence_service.transports.unary import UnaryMethods

log = logging.getLogger(__name__)

_MIB = 1 << 20


@dataclass(frozen=True, slots=True, eq=False)
class HttpTransport:
    """The HTTP server while it runs."""

    server: HttpServer
    jobs: (
        JobQueue | None
    )  # to be started when every graph is loaded; None: there is no disk for jobs
    schema: Callable[[], dict[str, Any]]  # OpenAPI
    pairs: APIRouter  # for the administrator's page too


@asynccontextmanager
async def serving_http(
    settings: Settings,
    host: str,
    engine: DepthEngine,
    unary: UnaryMethods,
    calls: OpenCalls,
    places: Places,
    *,
    connections: int,
    gate: Gate,
    certificate: Certificate | None,
    registry: CollectorRegistry,
) -> AsyncIterator[HttpTransport]:
    """Serve HTTP until the end of the block.

    The metrics of ``registry`` are served here too if only this machine can reach the server.

    Raises PortTaken if the server cannot listen on ``host``.
    """
    batch = settings.batch
    min_bytes_per_s = settings.limits.min_kib_per_s * 1024
    pair = UploadLimits(
        max_bytes=2 * settings.limits.max_frame_mib * _MIB,
        max_bytes_setting="limits.max_frame_mib",
        idle_s=batch.idle_s,
        min_bytes_per_s=min_bytes_per_s,
        archive=ArchiveLimits(max_files=2, max_unpacked_bytes=0, max_ratio=0),  # no archives
    )
    stopping = asyncio.Event()
    async with AsyncExitStack() as stack:
        # First of all: a server that cannot listen must not take a folder of jobs.
        listening = stack.enter_context(
            listening_socket(host, settings.http.port, transport="http")
        )
        pairs = pair_routes(engine, places, limits=pair)
        routes = [
            pairs,
            inference_routes(engine, places, limits=pair),
            stream_routes(
                calls,
                unary,
                patience_s=settings.limits.first_message_s,
                min_bytes_per_s=min_bytes_per_s,
            ),
        ]
        if gate.open and is_loopback(host):
            routes.append(metrics_routes(registry))
        queue: JobQueue | None = None
        try:
            store = stack.enter_context(_job_store(settings))
        except StoreUnavailable as error:
            # Without a disk the server can still serve live streams.
            log.warning("this server accepts no sequences: %s", error)
            routes.append(no_sequence_routes(str(error)))
        else:
            upload = _upload_limits(settings, store)
            queue = await stack.enter_async_context(
                JobQueue(
                    engine,
                    store,
                    limits=QueueLimits(
                        waiting=batch.waiting,
                        waiting_per_client=batch.waiting_per_client,
                        waiting_per_principal=settings.limits.waiting_sequences,
                        checkpoint_s=batch.checkpoint_s,
                        keep_s=batch.keep_h * 3600,
                        disk_bytes=_bytes_of(batch.disk_mib),
                        principal_bytes=_bytes_of(settings.limits.sequences_mib),
                        webhook_hosts=batch.webhook_hosts,
                        inputs=batch.inputs,
                    ),
                )
            )
            routes.append(
                sequence_routes(queue, model=engine.card.name, limits=upload, stopping=stopping)
            )
        app = make_http_app(
            version=version("vergence"),
            ready=lambda: engine.ready,
            routes=routes,
        )
        shared: ASGIApp = app
        port = listening.getsockname()[1]
        if queue and (passing := with_other_servers(app, queue, settings, host=host, port=port)):
            shared = await stack.enter_async_context(passing)
        server = await stack.enter_async_context(
            HttpServer(
                Border(shared, gate=gate, hosts=host_names(settings)),
                calls,
                listening=listening,
                limits=ConnectionLimits(
                    connections=connections,
                    headers_s=settings.limits.first_message_s,
                    write_s=settings.limits.write_s,
                    min_bytes_per_s=min_bytes_per_s,
                ),
                stopping=stopping,
                certificate=certificate,
                trusted_proxies=settings.security.trusted_proxies,
            )
        )
        yield HttpTransport(server, queue, app.openapi, pairs)


def _bytes_of(mib: int | None) -> int | None:
    return None if mib is None else mib * _MIB


def _upload_limits(settings: Settings, store: JobStore) -> UploadLimits:
    batch = settings.batch
    room = free_bytes(store.directory)
    unpacked_bytes = _bytes_of(batch.max_unpacked_mib)
    upload_bytes = _bytes_of(batch.max_upload_mib)
    return UploadLimits(
        max_bytes=room if upload_bytes is None else upload_bytes,
        max_bytes_setting="batch.max_upload_mib",
        idle_s=batch.idle_s,
        min_bytes_per_s=settings.limits.min_kib_per_s * 1024,
        archive=ArchiveLimits(
            max_files=batch.max_files,
            max_unpacked_bytes=room if unpacked_bytes is None else unpacked_bytes,
            max_ratio=batch.max_ratio,
        ),
    )


@contextmanager
def _job_store(settings: Settings) -> Iterator[JobStore]:
    """Open the folder of the settings, or a default one that no other server uses.

    The first server takes ``batch``. Another one takes ``batch-PORT``, now and at its next start;
    without a port of its own it takes a folder that ends with it. Raises StoreUnavailable.
    """
    state = os.environ.get("XDG_STATE_HOME")
    base = (Path(state) if state else Path.home() / ".local" / "state") / "vergence"
    shared, own = base / "batch", base / f"batch-{settings.http.port}"
    with ExitStack() as stack:
        if settings.batch.directory is not None:
            store = stack.enter_context(JobStore(settings.batch.directory))
        elif settings.http.port and own.exists():
            store = stack.enter_context(JobStore(own))
        else:
            try:
                store = stack.enter_context(JobStore(shared))
            except StoreInUse:
                if not settings.http.port:
                    own = Path(stack.enter_context(TemporaryDirectory(prefix="vergence-batch-")))
                log.info("another server keeps its sequences in %s, this one in %s", shared, own)
                store = stack.enter_context(JobStore(own))
        yield store
