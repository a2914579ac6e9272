"""The composition root: settings in, a running server out."""

import asyncio
import logging
import os
import signal
import time
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

from prometheus_client import CollectorRegistry

from vergence_service.archives import ArchiveLimits
from vergence_service.batcher import StepBatcher
from vergence_service.continuity import ContinuityLimits
from vergence_service.engine import DepthEngine
from vergence_service.job_queue import JobQueue, QueueLimits
from vergence_service.jobs import JobStore, StoreUnavailable
from vergence_service.metrics import Metrics
from vergence_service.model import OnnxStereoModel, StereoModel, packaged_weights_dir
from vergence_service.settings import Settings
from vergence_service.streams import StreamTable
from vergence_service.transports import place
from vergence_service.transports.calls import OpenCalls
from vergence_service.transports.depth_call import StreamLimits
from vergence_service.transports.grpc_server import DepthServicer, GrpcServer
from vergence_service.transports.http_app import HttpServer, make_http_app
from vergence_service.transports.http_pairs import pair_routes
from vergence_service.transports.http_sequences import no_sequence_routes, sequence_routes
from vergence_service.transports.http_uploads import UploadLimits
from vergence_service.transports.unary import UnaryMethods
from vergence_service.zenoh_face import ZenohFace, on_zenoh

log = logging.getLogger(__name__)

_MIB = 1 << 20
_SWEEP_EVERY_S = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Running:
    """A server that serves."""

    grpc_address: str
    http_address: str
    engine: DepthEngine
    grpc: GrpcServer
    zenoh: ZenohFace | None


def make_model(settings: Settings) -> OnnxStereoModel:
    """Raises ManifestError, ProviderUnavailable, FileNotFoundError: no such weights here."""
    return OnnxStereoModel(
        settings.model.weights or packaged_weights_dir(),
        settings.model.name,
        providers=settings.model.providers,
        threads=settings.model.threads,
        allow_spinning=settings.model.allow_spinning,
    )


@asynccontextmanager
async def running(
    settings: Settings, model: StereoModel, *, clock: Callable[[], float] = time.monotonic
) -> AsyncIterator[Running]:
    """A server from its first listening socket to its last; inside the block it serves.

    Raises PortTaken, ExtraMissing, ZenohUnreachable, and what the model raises when it loads.
    """
    registry = CollectorRegistry()
    metrics = Metrics(registry)
    streams = StreamTable(
        capacity=settings.streams.capacity,
        max_state_bytes=settings.streams.max_state_mib * _MIB,
        idle_timeout_s=settings.streams.idle_timeout_s,
        idle_notice_s=settings.streams.idle_notice_s,
        detach_grace_s=settings.streams.detach_grace_s,
        clock=clock,
        metrics=metrics,
    )
    batcher = StepBatcher(model, max_batch=settings.model.max_batch, clock=clock, metrics=metrics)
    engine = DepthEngine(
        streams,
        batcher,
        card=model.card,
        iterations=settings.model.iterations,
        cold_iterations=settings.model.cold_iterations,
        limits=ContinuityLimits(**settings.continuity.model_dump()),
        max_pixels=settings.streams.max_pixels,
        clock=clock,
        metrics=metrics,
    )
    max_frame_bytes = settings.grpc.max_frame_mib * _MIB
    limits = StreamLimits(
        credit=settings.grpc.credit,
        waiting_frames=settings.grpc.waiting_frames,
        max_frame_bytes=max_frame_bytes,
    )
    unary = UnaryMethods(engine, provider=model.provider, max_frame_bytes=max_frame_bytes)

    def open_calls() -> OpenCalls:
        return OpenCalls(engine, limits=limits, clock=clock)

    # Outermost ends last: no transport outlives the batcher that it feeds.
    async with (
        batcher,
        GrpcServer(
            DepthServicer(unary, open_calls()),
            host=settings.grpc.host,
            port=settings.grpc.port,
            max_frame_bytes=max_frame_bytes,
        ) as grpc_server,
        _serving_http(settings, engine, registry) as (http_server, start_jobs),
        on_zenoh(settings, unary, open_calls()) as zenoh,
        _sweeping(streams),
    ):
        await engine.start()
        start_jobs()
        await grpc_server.serving()
        if zenoh is not None:
            await zenoh.server.serving()
        yield Running(
            place(settings.grpc.host, grpc_server.port),
            place(settings.http.host, http_server.port),
            engine,
            grpc_server,
            zenoh,
        )


async def serve(settings: Settings, *, on_serving: Callable[[Running], None]) -> None:
    """Serve until SIGTERM or SIGINT, then drain. Raises as make_model and running."""
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    async with running(settings, make_model(settings)) as server:
        on_serving(server)
        await stop.wait()
        await drain(server, within_s=settings.grpc.drain_s)


async def drain(server: Running, *, within_s: float) -> None:
    """Tell clients, let them leave, answer what they have sent; within twice the time given."""
    server.engine.drain(within_s=within_s)
    async with asyncio.TaskGroup() as tasks:
        tasks.create_task(server.grpc.drain(within_s=within_s))
        if server.zenoh is not None:
            tasks.create_task(server.zenoh.server.drain(within_s=within_s))


@asynccontextmanager
async def _serving_http(
    settings: Settings, engine: DepthEngine, registry: CollectorRegistry
) -> AsyncIterator[tuple[HttpServer, Callable[[], None]]]:
    """The HTTP face, and what starts its jobs once the model is there."""
    batch = settings.batch
    archive = ArchiveLimits(
        max_files=batch.max_files,
        max_unpacked_bytes=batch.max_unpacked_mib * _MIB,
        max_ratio=batch.max_ratio,
    )
    upload = UploadLimits(
        max_bytes=batch.max_upload_mib * _MIB, idle_s=batch.idle_s, archive=archive
    )
    pair = UploadLimits(
        max_bytes=2 * settings.grpc.max_frame_mib * _MIB,
        idle_s=batch.idle_s,
        archive=replace(archive, max_files=2),
    )
    stopping = asyncio.Event()
    async with AsyncExitStack() as stack:
        routes = [pair_routes(engine, limits=pair)]
        start: Callable[[], None]
        try:
            store = stack.enter_context(JobStore(batch.directory or _default_jobs_directory()))
        except StoreUnavailable as error:
            # Live depth is worth serving without a disk.
            log.warning("sequences are not taken: %s", error)
            routes.append(no_sequence_routes(str(error)))
            start = _nothing
        else:
            queue = await stack.enter_async_context(
                JobQueue(
                    engine,
                    store,
                    limits=QueueLimits(
                        waiting=batch.waiting,
                        keep_s=batch.keep_h * 3600,
                        disk_bytes=batch.disk_mib * _MIB,
                    ),
                )
            )
            routes.append(
                sequence_routes(queue, model=engine.card.name, limits=upload, stopping=stopping)
            )
            start = queue.start
        app = make_http_app(
            version=version("vergence"),
            ready=lambda: engine.ready,
            registry=registry,
            routes=routes,
        )
        server = await stack.enter_async_context(
            HttpServer(app, host=settings.http.host, port=settings.http.port, stopping=stopping)
        )
        yield server, start


def _nothing() -> None:
    """No jobs are to be started."""


def _default_jobs_directory() -> Path:
    state = os.environ.get("XDG_STATE_HOME")
    return (Path(state) if state else Path.home() / ".local" / "state") / "vergence" / "batch"


@asynccontextmanager
async def _sweeping(streams: StreamTable) -> AsyncIterator[None]:
    async def sweep() -> None:
        while True:
            await asyncio.sleep(_SWEEP_EVERY_S)
            streams.sweep()

    task = asyncio.create_task(sweep(), name="sweep")
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
