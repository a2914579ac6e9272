"""Compose the server from its settings, run it, and drain it at the end."""

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import AbstractAsyncContextManager, asynccontextmanager, closing, nullcontext
from dataclasses import dataclass
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from prometheus_client import CollectorRegistry, ProcessCollector

from vergence_proto.model_io import folder_of_model, user_models_dir
from vergence_proto.stopping import STOP_SIGNALS, on_end_of_input, on_signals
from vergence_proto.types import Delivery
from vergence_service.app.admin import serving_admin
from vergence_service.app.http import serving_http
from vergence_service.app.security import (
    check_exposure,
    keep_current,
    make_certificate,
    make_gate,
)
from vergence_service.app.snapshots import make_snapshots
from vergence_service.app.zenoh import ZenohTransport, serving_zenoh
from vergence_service.inference.batcher import StepBatcher
from vergence_service.inference.engines import load_model
from vergence_service.inference.installed import packaged_weights_dir
from vergence_service.inference.model import StereoModel
from vergence_service.jobs.places import Places
from vergence_service.jobs.queue import JobQueue
from vergence_service.process.descriptors import affordable_connections
from vergence_service.process.memory import MemoryBudget, affordable_bytes
from vergence_service.process.metrics import Metrics
from vergence_service.process.native_output import native_output
from vergence_service.process.threads import Threads
from vergence_service.settings import Settings
from vergence_service.streams.continuity import ContinuityLimits
from vergence_service.streams.engine import DepthEngine
from vergence_service.streams.needs import ImageSizes
from vergence_service.streams.quotas import Quotas
from vergence_service.streams.stream import Stream
from vergence_service.streams.table import StreamTable
from vergence_service.streams.turns import Turns
from vergence_service.transports.addresses import format_address
from vergence_service.transports.errors import ExtraMissing
from vergence_service.transports.grpc.inference_protocol import InferenceServicer
from vergence_service.transports.grpc.server import DepthServicer, GrpcServer
from vergence_service.transports.http.app import HttpServer
from vergence_service.transports.open_calls import OpenCalls
from vergence_service.transports.stream_call import StreamLimits
from vergence_service.transports.unary import UnaryMethods

if TYPE_CHECKING:
    from vergence_service.inference.engines import ServedModel

_MIB = 1 << 20
_SWEEP_EVERY_S = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Running:
    """A server while it serves."""

    grpc_address: str
    http_address: str
    admin_address: str
    engine: DepthEngine
    grpc: GrpcServer
    http: HttpServer
    jobs: JobQueue | None
    zenoh: ZenohTransport | None
    loading: asyncio.Task[None]  # of the graphs that live streams do not need


def make_model(settings: Settings) -> "ServedModel":
    """Load the model card of the settings.

    Raises ManifestError if the manifest cannot be used, ProviderUnavailable if the engine or an
    execution provider is missing, and FileNotFoundError if there are no weights.
    """
    name = settings.model.name
    weights = settings.model.weights
    return load_model(
        weights or folder_of_model(name, [packaged_weights_dir(), user_models_dir()]),
        name,
        engine=settings.model.engine,
        providers=settings.model.providers,
        threads=settings.model.threads,
        allow_spinning=settings.model.allow_spinning,
    )


@asynccontextmanager
async def running(
    settings: Settings, model: StereoModel, *, clock: Callable[[], float] = time.monotonic
) -> AsyncIterator[Running]:
    """Run a server; it serves until the end of the block.

    Raises SettingsError if strangers could reach it or its tokens or certificate cannot be read,
    PortTaken if a port is in use, ExtraMissing if an optional package is not installed,
    ZenohUnreachable if its network cannot be joined, and ManifestError or ProviderUnavailable if
    the model cannot be loaded.
    """
    check_exposure(settings)
    gate, certificate = make_gate(settings), make_certificate(settings)
    registry = CollectorRegistry()
    metrics = Metrics(registry)
    metrics.build_info.labels(
        version("vergence"),
        model.card.name,
        model.card.weights_sha256[:12],
        model.engine,
        model.provider,
    ).set(1)
    ProcessCollector(registry=registry)
    memory = MemoryBudget(settings.limits.max_state_mib * _MIB, metrics=metrics)
    batcher = StepBatcher(
        model, max_batch=settings.model.max_batch, memory=memory, clock=clock, metrics=metrics
    )
    # As many as the model takes at once. One more, decoded ahead, halved what a stream got beside
    # one with large images. A batch needs the next batch to wait already.
    at_once = max(model.max_concurrent_steps, settings.model.max_batch)
    turns = Turns(
        places=2 * at_once if settings.model.max_batch > 1 else at_once,
        lanes=model.max_concurrent_steps,
        clock=clock,
    )

    metrics.turns_waiting.set_function(lambda: len(turns))

    def closed(stream: Stream) -> None:
        batcher.forget(stream.key)
        turns.forget(stream.key)
        if stream.saver is not None:
            stream.saver.close()

    streams = StreamTable(
        capacity=settings.streams.capacity,
        quotas=Quotas(
            streams=settings.limits.streams,
            state_bytes=settings.limits.state_mib * _MIB,
            megapixels_per_s=settings.limits.megapixels_per_s,
            streams_per_client=settings.limits.streams_per_client,
        ),
        memory=memory,
        idle_timeout_s=settings.streams.idle_timeout_s,
        idle_notice_s=settings.streams.idle_notice_s,
        detach_grace_s=settings.streams.detach_grace_s,
        silent_s=settings.limits.silent_s,
        clock=clock,
        metrics=metrics,
        on_closed=closed,
    )
    threads = Threads(lanes=model.max_concurrent_steps)
    snapshots = make_snapshots(settings, threads, metrics=metrics)
    engine = DepthEngine(
        streams,
        batcher,
        model=model,
        memory=memory,
        iterations=settings.model.iterations,
        cold_iterations={
            Delivery.NEWEST: settings.model.cold_iterations,
            Delivery.EVERY: settings.model.cold_iterations_every,
        },
        limits=ContinuityLimits(**settings.continuity.model_dump()),
        sizes=ImageSizes(
            max_pixels=settings.limits.max_pixels, max_side=settings.limits.max_side_px
        ),
        min_range_share=settings.model.min_range_share,
        clock=clock,
        metrics=metrics,
        threads=threads,
        turns=turns,
        snapshots=snapshots,
    )
    max_frame_bytes = settings.limits.max_frame_mib * _MIB
    limits = StreamLimits(
        credit=settings.streams.credit,
        paced_credit=max(settings.streams.paced_credit, settings.streams.credit),
        waiting_frames=settings.streams.waiting_frames,
        max_frame_bytes=max_frame_bytes,
        silent_s=settings.limits.silent_s,
        write_s=settings.limits.write_s,
        iterations=settings.limits.iterations,
    )
    unary = UnaryMethods(
        engine,
        computed_by=model.engine,
        provider=model.provider,
        max_frame_bytes=max_frame_bytes,
    )

    places = Places(settings.limits.pairs)
    metrics.pairs.set_function(lambda: len(places))
    connections = affordable_connections(settings.limits.connections)

    def open_calls(transport: str) -> OpenCalls:
        return OpenCalls(engine, transport=transport, limits=limits, clock=clock)

    grpc_host = settings.grpc.host or settings.server.host
    http_host = settings.http.host or settings.server.host
    # The outermost context ends last: no transport outlives the batcher that it uses.
    async with (
        threads,
        _traces(settings, engine),
        snapshots or nullcontext(),
        batcher,
        GrpcServer(
            DepthServicer(unary, open_calls("grpc")),
            InferenceServicer(engine, places, max_frame_bytes=max_frame_bytes),
            host=grpc_host,
            port=settings.grpc.port,
            max_frame_bytes=max_frame_bytes,
            max_connections=connections,
            first_message_s=settings.limits.first_message_s,
            gate=gate,
            certificate=certificate,
        ) as grpc_server,
        serving_http(
            settings,
            http_host,
            engine,
            unary,
            open_calls("http"),
            places,
            connections=connections,
            gate=gate,
            certificate=certificate,
            registry=registry,
        ) as http,
        serving_zenoh(settings, unary, open_calls("zenoh"), gate) as zenoh,
        serving_admin(
            settings, engine, registry, gate, certificate, http=http, clock=clock
        ) as admin,
        _in_background(_sweep(streams)),
        _in_background(keep_current(gate, certificate, engine)),
    ):
        await engine.start()
        memory.reduce_to(affordable_bytes(settings.limits.max_state_mib * _MIB))
        await grpc_server.serving()
        if zenoh is not None:
            await zenoh.server.serving()
        async with _in_background(_load_rest(engine, http.jobs)) as loading:
            yield Running(
                format_address(grpc_host, grpc_server.port),
                format_address(http_host, http.server.port),
                format_address(settings.admin.host, admin.port),
                engine,
                grpc_server,
                http.server,
                http.jobs,
                zenoh,
                loading,
            )


async def serve(
    settings: Settings,
    *,
    on_serving: Callable[[Running], None],
    on_stopping: Callable[[], None],
    until_eof: bool = False,
) -> None:
    """Serve until SIGTERM, SIGINT or SIGHUP, then drain; ``until_eof``: or until the input ends.

    ``on_stopping`` is called when the drain begins.

    Raises FileNotFoundError, ManifestError or ProviderUnavailable if the model cannot be loaded;
    PortTaken, ExtraMissing or ZenohUnreachable if a transport cannot start.
    """
    stop = asyncio.Event()

    def stop_serving(_: int) -> None:
        if not stop.is_set():
            on_stopping()
            stop.set()

    on_signals(STOP_SIGNALS, stop_serving)
    if until_eof:
        on_end_of_input(stop_serving)
    with closing(make_model(settings)) as model:
        async with running(settings, model) as server:
            messages = server.engine.metrics.decoder_messages
            with native_output(lambda decoder: messages.labels(decoder).inc()):
                on_serving(server)
                # A graph that cannot be loaded ends the server; its error leaves `running`.
                server.loading.add_done_callback(lambda task: stop.set() if _failed(task) else None)
                await stop.wait()
                await drain(server, within_s=settings.server.drain_s)


async def drain(server: Running, *, within_s: float) -> None:
    """Notify clients, let them leave, and answer what they have sent, in twice ``within_s``.

    Jobs stop at once: they keep their place and their progress for the next server.
    """
    server.engine.drain(within_s=within_s)
    async with asyncio.TaskGroup() as tasks:
        if server.jobs is not None:
            tasks.create_task(server.jobs.stop())
        tasks.create_task(server.grpc.drain(within_s=within_s))
        tasks.create_task(server.http.drain(within_s=within_s))
        if server.zenoh is not None:
            tasks.create_task(server.zenoh.server.drain(within_s=within_s))


def _traces(settings: Settings, engine: DepthEngine) -> AbstractAsyncContextManager[None]:
    if not settings.server.traces:
        return nullcontext()
    try:
        from vergence_service.app.traces import span_per_frame
    except ModuleNotFoundError:
        raise ExtraMissing("OpenTelemetry", "otel") from None
    return span_per_frame(engine)


async def _load_rest(engine: DepthEngine, jobs: JobQueue | None) -> None:
    await engine.load_rest()
    if jobs is not None:
        jobs.start()


async def _sweep(streams: StreamTable) -> None:
    while True:
        await asyncio.sleep(_SWEEP_EVERY_S)
        streams.sweep()


@asynccontextmanager
async def _in_background(work: Coroutine[Any, Any, None]) -> AsyncIterator[asyncio.Task[None]]:
    """Run ``work`` beside the block. The end of the block cancels it, or raises its error."""
    task = asyncio.create_task(work)
    try:
        yield task
    finally:
        task.cancel()
        await asyncio.wait([task])
    if _failed(task):
        task.result()


def _failed(task: asyncio.Task[None]) -> bool:
    return not task.cancelled() and task.exception() is not None
