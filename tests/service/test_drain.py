"""The server is ready when the model is loaded, drains on a signal, and owns its port."""

import asyncio
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import grpc
import httpx
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc

from tests.support.frames import frame_message, make_frame, open_message
from tests.support.http import ended, http_to, metrics_of, submit
from tests.support.models import PacedModel, RecallModel
from tests.support.polling import eventually_true
from tests.support.sequences import make_frames, sequence_files, zip_bytes
from tests.support.server import RawCall, connected, raw_stream, running_server
from tests.support.status import reason_of
from tests.support.weights_copy import WEIGHTS
from vergence_proto.v1 import depth_pb2 as pb
from vergence_proto.v1 import depth_pb2_grpc
from vergence_service.app.server import Running, drain, serve
from vergence_service.settings import load_settings
from vergence_service.transports.errors import PortTaken

REPOSITORY = Path(__file__).parents[2]
SERVING = health_pb2.HealthCheckResponse.SERVING
NOT_SERVING = health_pb2.HealthCheckResponse.NOT_SERVING


async def test_a_drain_says_so_answers_what_is_in_flight_and_ends_the_call() -> None:
    model = RecallModel()
    async with running_server(model) as server, raw_stream(server, "mine") as call:
        with model.busy():
            for i in (1, 2):
                await call.send(frame_message(make_frame(i)))
            await asyncio.to_thread(model.wait_until_entered)
            draining = asyncio.create_task(drain(server, within_s=0.2))
            notice = await call.receive()
            assert notice is not None
            assert notice.notice.kind == pb.NOTICE_KIND_DRAINING
            assert notice.notice.in_s == pytest.approx(0.2)
        assert [(await call.receive()).disparity.frame_id for _ in range(2)] == [1, 2]  # type: ignore[union-attr]
        with pytest.raises(grpc.aio.AioRpcError) as failure:
            await call.receive()
        await draining
    assert failure.value.code() is grpc.StatusCode.UNAVAILABLE
    assert reason_of(failure.value) == "DRAINING"


async def test_a_client_that_leaves_at_the_notice_ends_the_drain_at_once() -> None:
    async with running_server(RecallModel()) as server, raw_stream(server, "mine") as call:
        draining = asyncio.create_task(drain(server, within_s=3600))
        assert (await call.receive()) is not None
        await call.send(pb.StreamDepthRequest(end=pb.End()))
        assert await call.receive() is None
        await asyncio.wait_for(draining, 10)


async def test_a_draining_server_takes_no_new_stream() -> None:
    async with running_server(RecallModel()) as server, connected(server) as stub:
        server.engine.drain(within_s=1)
        with pytest.raises(grpc.aio.AioRpcError) as failure:
            await RawCall(stub.StreamDepth()).ask(open_message())
        assert reason_of(failure.value) == "DRAINING"


async def test_health_is_watched_from_serving_to_draining() -> None:
    async with (
        running_server(RecallModel()) as server,
        grpc.aio.insecure_channel(server.grpc_address) as channel,
    ):
        stub = health_pb2_grpc.HealthStub(channel)
        request = health_pb2.HealthCheckRequest(service="vergence.v1.DepthService")
        watch = stub.Watch(request)
        seen = [(await asyncio.wait_for(watch.read(), 10)).status]
        draining = asyncio.create_task(drain(server, within_s=1))
        seen.append((await asyncio.wait_for(watch.read(), 10)).status)
        watch.cancel()
        await draining
    assert seen == [SERVING, NOT_SERVING]


async def test_http_reports_life_readiness_and_counts() -> None:
    async with running_server(RecallModel()) as server, raw_stream(server) as call:
        await call.ask(frame_message(make_frame(1)))
        late = frame_message(make_frame(1))
        await call.ask(late)
        async with http_to(server) as http:
            assert (await http.get("/healthz")).json() == {"status": "alive"}
            assert (await http.get("/readyz")).status_code == 200
            metrics = (await metrics_of(http)).splitlines()
            server.engine.drain(within_s=1)
            assert (await http.get("/readyz")).status_code == 503
            assert (await http.get("/healthz")).status_code == 200
    assert 'vergence_frames_stepped_total{origin="cold_start"} 1.0' in metrics
    assert 'vergence_frames_failed_total{reason="FRAME_OUT_OF_ORDER"} 1.0' in metrics
    assert "vergence_streams_open 1.0" in metrics
    assert 'vergence_stage_seconds_count{stage="model"} 1.0' in metrics


@pytest.mark.parametrize("transport", ["grpc", "http"])
async def test_a_second_server_on_a_port_fails_and_says_so(transport: str) -> None:
    async with running_server(RecallModel()) as server:
        port = int(getattr(server, f"{transport}_address").rsplit(":", 1)[1])
        taken: dict[str, Any] = {f"{transport}__port": port}
        with pytest.raises(PortTaken, match=f"{port}.*{transport}.port.*--{transport}-port 0"):
            await running_server(RecallModel(), **taken).__aenter__()


async def test_an_address_of_another_machine_is_distinguished_from_a_port_that_is_taken() -> None:
    with pytest.raises(PortTaken, match="choose another address with --host"):
        await running_server(
            RecallModel(), server__host="203.0.113.1", security__insecure=True
        ).__aenter__()


@contextmanager
def served(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """A server process."""
    process = subprocess.Popen(
        [sys.executable, "-m", "vergence_service", *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


# A small model, which is loaded at once.
SMALL = (
    *("--grpc-port", "0", "--http-port", "0", "--threads", "1"),
    *("--weights", str(WEIGHTS), "--model", "whole"),
)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT], ids=lambda number: number.name)
def test_the_process_reports_its_addresses_and_ends_cleanly_on_a_signal(
    number: signal.Signals,
) -> None:
    with served(*SMALL) as process:
        assert process.stdout is not None
        word, *addresses = process.stdout.readline().split()
        assert word == "listening"
        ports = dict(address.split("=127.0.0.1:") for address in addresses)
        assert set(ports) == {"grpc", "http"}
        ready = httpx.get(f"http://127.0.0.1:{ports['http']}/readyz")
        assert ready.json() == {"status": "ready"}
        os.kill(process.pid, number)
        assert process.wait(timeout=20) == 0


async def test_a_process_ends_in_time_whatever_its_threads_do(tmp_path: Path) -> None:
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "tests.support.slow_server", "600"),
        cwd=REPOSITORY,
        env={
            **os.environ,
            "VERGENCE_SERVER__DRAIN_S": "0.5",
            "VERGENCE_BATCH__DIRECTORY": str(tmp_path),
        },
        stdout=asyncio.subprocess.PIPE,
    )
    try:
        assert process.stdout is not None
        _, address, _ = (await process.stdout.readline()).decode().split()
        async with grpc.aio.insecure_channel(address.removeprefix("grpc=")) as channel:
            call = RawCall(depth_pb2_grpc.DepthServiceStub(channel).StreamDepth())
            await call.ask(open_message("mine"))
            await call.send(frame_message(make_frame(1)))  # ten minutes in the model
            await call.ask(pb.StreamDepthRequest(ping=pb.Ping()))
            process.send_signal(signal.SIGTERM)
            notice = await call.receive()
            assert notice is not None
            assert notice.notice.kind == pb.NOTICE_KIND_DRAINING
            assert await asyncio.wait_for(process.wait(), 30) == 0
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()


async def test_a_job_keeps_its_progress_when_the_server_drains(tmp_path: Path) -> None:
    flags: dict[str, Any] = {"batch__directory": tmp_path, "batch__checkpoint_s": 3600}
    archive = zip_bytes(sequence_files(make_frames(40)))
    async with (
        running_server(PacedModel(0.05), **flags) as server,
        http_to(server) as http,
    ):
        job_id = (await submit(http, archive))["id"]

        async def has_begun() -> bool:
            return bool((await http.get(f"/v1/sequences/{job_id}")).json()["frames_done"])

        await eventually_true(has_begun)
        await drain(server, within_s=0.1)
        assert (tmp_path / "jobs" / job_id / "checkpoint").exists()
    async with running_server(RecallModel(), **flags) as server, http_to(server) as http:
        assert (await ended(http, job_id))["state"] == "done"
        metrics = await metrics_of(http)
    assert "vergence_sequence_frames_total 40.0" not in metrics, "all frames were stepped again"


def test_the_end_of_its_input_ends_a_server_that_a_program_started() -> None:
    with served(*SMALL, "--until-eof") as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("listening")
        process.communicate(timeout=20)  # closes its input
        assert process.returncode == 0


async def test_a_server_starts_and_ends_where_no_event_loop_handles_signals(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every event loop of Windows raises NotImplementedError."""

    def refuse(*_: object) -> None:
        raise NotImplementedError

    monkeypatch.setattr(asyncio.get_running_loop(), "add_signal_handler", refuse)
    before = {number: signal.getsignal(number) for number in (1, signal.SIGINT, signal.SIGTERM)}
    model = {"model.weights": WEIGHTS, "model.name": "whole", "model.threads": 1}
    settings = load_settings(
        flags={"grpc.port": 0, "http.port": 0, "batch.directory": tmp_path, **model}
    )
    served_at: list[str] = []
    stopping = asyncio.Event()

    def on_serving(server: Running) -> None:
        served_at.append(server.grpc_address)
        os.kill(os.getpid(), signal.SIGTERM)

    try:
        await asyncio.wait_for(serve(settings, on_serving=on_serving, on_stopping=stopping.set), 20)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    assert served_at
    assert stopping.is_set()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--config", "nowhere.toml"], "cannot read nowhere.toml"),
        (["--model", "huge"], "has no model 'huge'; it has lite"),
        (["--weights", "/nowhere"], "no manifest at /nowhere"),
        (["--grpc-port", "70000"], "grpc.port"),
        (["--grpc-port", "TAKEN"], "another server uses this port"),
    ],
    ids=["no-file", "no-model", "no-weights", "bad-port", "taken-port"],
)
def test_what_an_operator_can_mend_is_reported_in_one_line(arguments: list[str], says: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        taken = str(other.getsockname()[1])
        words = [word.replace("TAKEN", taken) for word in arguments]
        with served("--http-port", "0", *words) as process:
            _, errors = process.communicate(timeout=30)
    assert process.returncode == 2
    starting, *log, trouble = errors.splitlines()
    assert starting == "vergence serve: starting"
    assert all(" INFO " in line for line in log)  # such as which engine computes
    assert says in trouble
