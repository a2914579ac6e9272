"""A server that starts: it listens first, serves live streams next, and everything in the end."""

import asyncio
import socket
import subprocess
import sys
import threading
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path

import grpc
import httpx
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc
from prometheus_client import CollectorRegistry

from tests.support.frames import RIG, frame_message, make_frame
from tests.support.models import RecallModel
from tests.support.polling import eventually_true, turns
from tests.support.server import ManualClock, raw_stream, running_server
from tests.support.weights_copy import Entry, copied_weights
from vergence_proto.errors import NotReady
from vergence_proto.types import Delivery, StereoRig
from vergence_service.inference.batcher import StepBatcher
from vergence_service.jobs.store import JobStore, StoreInUse
from vergence_service.process.memory import MemoryBudget
from vergence_service.process.metrics import Metrics
from vergence_service.process.threads import Threads
from vergence_service.streams import engine as engine_module
from vergence_service.streams.continuity import ContinuityLimits
from vergence_service.streams.engine import DepthEngine
from vergence_service.streams.needs import ImageSizes
from vergence_service.streams.quotas import Quotas
from vergence_service.streams.stream import StreamConfig
from vergence_service.streams.table import StreamTable
from vergence_service.transports.errors import PortTaken

OPENING = StreamConfig(StereoRig.from_rectified(RIG))
HEALTH_NAMES = ["", "vergence.v1.DepthService"]
FEW, MANY = 1, 4  # iterations of a cold step: of live streams, of lossless ones


class SlowToLoad(RecallModel):
    """Its graphs of ``iterations`` are loaded when the test says so."""

    def __init__(self, iterations: int) -> None:
        super().__init__()
        self._slow = iterations
        self._may_load = threading.Event()

    def warm_up(self, iterations: int, *cold_iterations: int) -> None:
        if self._slow in (iterations, *cold_iterations):
            assert self._may_load.wait(timeout=30)

    @contextmanager
    def loading(self) -> Iterator[None]:
        """Load nothing in the block."""
        try:
            yield
        finally:
            self._may_load.set()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


async def test_live_streams_are_served_while_slower_graphs_are_loaded() -> None:
    model = SlowToLoad(MANY)
    with model.loading():
        async with running_server(model, model__cold_iterations=FEW) as server:
            async with raw_stream(server) as call:
                answer = await call.ask(frame_message(make_frame(1)))
            assert answer.disparity.frame_id == 1
            url = f"http://{server.http_address}/readyz"
            assert (await asyncio.to_thread(httpx.get, url)).status_code == 200
            assert not server.loading.done()


async def test_an_early_client_sees_that_the_server_loads_and_is_served_when_it_has() -> None:
    model, ports = SlowToLoad(FEW), (free_port(), free_port())
    with model.loading():
        starting = running_server(model, grpc__port=ports[0], http__port=ports[1])
        entering = asyncio.create_task(starting.__aenter__())
        url = f"http://127.0.0.1:{ports[1]}"
        async with (
            httpx.AsyncClient(base_url=url) as http,
            grpc.aio.insecure_channel(f"127.0.0.1:{ports[0]}") as channel,
        ):

            async def listens() -> bool:
                try:
                    return (await http.get("/healthz")).status_code == 200
                except httpx.TransportError:
                    return False

            await eventually_true(listens)
            assert (await http.get("/readyz")).status_code == 503
            stub = health_pb2_grpc.HealthStub(channel)
            statuses = [
                (await stub.Check(health_pb2.HealthCheckRequest(service=name))).status
                for name in HEALTH_NAMES
            ]
            assert statuses == [health_pb2.HealthCheckResponse.NOT_SERVING] * 2
    server = await entering
    try:
        async with raw_stream(server) as call:
            assert (await call.ask(frame_message(make_frame(1)))).disparity.frame_id == 1
    finally:
        await starting.__aexit__(None, None, None)


@asynccontextmanager
async def not_started() -> AsyncIterator[DepthEngine]:
    """An engine whose model is not loaded."""
    model, metrics, clock = RecallModel(), Metrics(CollectorRegistry()), ManualClock()
    memory = MemoryBudget(1 << 30, metrics=metrics)
    batcher = StepBatcher(model, max_batch=1, memory=memory, clock=clock, metrics=metrics)
    streams = StreamTable(
        capacity=1,
        quotas=Quotas(),
        memory=memory,
        idle_timeout_s=60,
        idle_notice_s=10,
        detach_grace_s=10,
        silent_s=15,
        clock=clock,
        metrics=metrics,
        on_closed=lambda _: None,
    )
    async with Threads(lanes=1) as threads, batcher:
        yield DepthEngine(
            streams,
            batcher,
            model=model,
            memory=memory,
            iterations=1,
            cold_iterations=dict.fromkeys(Delivery, 4),
            limits=ContinuityLimits(max_gap_s=1, max_jump_m=1, max_jump_deg=45),
            sizes=ImageSizes(max_pixels=RIG.width * RIG.height, max_side=RIG.width),
            min_range_share=0.0,
            clock=clock,
            metrics=metrics,
            threads=threads,
        )


async def test_opening_before_the_model_is_loaded_waits_for_it() -> None:
    async with not_started() as engine:
        opening = asyncio.create_task(engine.open("early", OPENING))
        await turns()
        assert not engine.ready
        assert not opening.done()
        await engine.start()
        assert engine.ready
        assert (await opening).stream_id == "early"


async def test_a_wait_that_is_too_long_ends_with_when_to_come_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(engine_module, "_LOADING_PATIENCE_S", 0.01)
    async with not_started() as engine:
        with pytest.raises(NotReady, match="loading") as refusal:
            await engine.open("early", OPENING)
    assert refusal.value.retry_after_s == 1


def test_a_slow_graph_that_cannot_be_loaded_ends_the_server_in_one_line(tmp_path: Path) -> None:
    def spoil(entry: Entry) -> None:
        del entry["graphs"]["2"][0]

    weights = copied_weights(tmp_path, edit=spoil)
    command = [sys.executable, "-m", "vergence_service", "--grpc-port", "0", "--http-port", "0"]
    done = subprocess.run(
        [*command, "--model", "staged", "--weights", str(weights)],
        env={
            "PATH": "",
            "PYTHONPATH": ":".join(sys.path),
            "XDG_STATE_HOME": str(tmp_path),
            "VERGENCE_MODEL__COLD_ITERATIONS": "1",
            "VERGENCE_SERVER__DRAIN_S": "0.1",
        },
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2
    assert "staged, 2 iterations: expected" in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr


def jobs_folders(state: Path) -> set[str]:
    return {path.parent.name for path in (state / "vergence").glob("*/jobs.sqlite3")}


async def test_a_second_server_keeps_its_sequences_in_a_folder_of_its_own(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    port = free_port()
    own = f"batch-{port}"
    async with running_server(RecallModel(), batch__directory=None) as first:
        taken = int(first.http_address.rpartition(":")[2])
        with pytest.raises(PortTaken):
            await running_server(
                RecallModel(), batch__directory=None, http__port=taken
            ).__aenter__()
        assert jobs_folders(tmp_path) == {"batch"}
        async with (
            running_server(RecallModel(), batch__directory=None, http__port=port) as second,
            running_server(RecallModel(), batch__directory=None) as third,
        ):
            assert jobs_folders(tmp_path) == {"batch", own}
            for server in (second, third):
                url = f"http://{server.http_address}/v1/sequences"
                assert (await asyncio.to_thread(httpx.get, url)).status_code == 200
    # At its next start it finds its jobs again, even if the first folder is free now.
    async with running_server(RecallModel(), batch__directory=None, http__port=port):
        with JobStore(tmp_path / "vergence" / "batch"):
            pass
        with pytest.raises(StoreInUse, match="another server uses this folder"):
            JobStore(tmp_path / "vergence" / own).__enter__()
