"""Triton Inference Server over the same model, its sequence batcher in place of the service.

Its binary and its Python backend come from the package nvidia-pytriton, in its own environment.
"""

import asyncio
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import tritonclient.grpc.aio as triton

from tests.support.sockets import free_port

_MODEL = Path(__file__).with_name("triton_model")
_START_S = 90.0
_CREDIT = 2
_ANSWER_S = 20.0


@contextmanager
def triton_loop(weights: Path, instances: int, packages: Path) -> Iterator[tuple[str, int]]:
    """Yield the address and the process id of a server; ``packages`` has nvidia-pytriton."""
    server = packages / "pytriton" / "tritonserver"
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    grpc_port, http_port = free_port(), free_port()
    with tempfile.TemporaryDirectory() as scratch:
        backends = Path(scratch) / "backends"
        shutil.copytree(server / "backends", backends)
        stub = server / "python_backend_stubs" / version / "triton_python_backend_stub"
        shutil.copy(stub, backends / "python")
        model = Path(scratch) / "models" / "stereo"
        (model / "1").mkdir(parents=True)
        config = (_MODEL / "config.pbtxt").read_text()
        (model / "config.pbtxt").write_text(config.replace("$INSTANCES", str(instances)))
        shutil.copy(_MODEL / "model.py", model / "1")
        environment = {
            **os.environ,
            "LD_LIBRARY_PATH": str(packages / "nvidia_pytriton.libs"),
            "PYTHONPATH": os.pathsep.join([*filter(None, sys.path), sysconfig.get_path("purelib")]),
            "VERGENCE_MODEL__WEIGHTS": str(weights),
        }
        command = [
            str(server / "bin" / "tritonserver"),
            f"--model-repository={model.parent}",
            f"--backend-directory={backends}",
            f"--grpc-port={grpc_port}",
            f"--http-port={http_port}",
            "--allow-metrics=false",
        ]
        with (
            (Path(scratch) / "log").open("wb") as log,
            subprocess.Popen(command, env=environment, stdout=log, stderr=log) as process,
        ):
            try:
                _wait_until_ready(http_port, process, Path(scratch) / "log")
                yield f"127.0.0.1:{grpc_port}", process.pid
            finally:
                process.terminate()


async def triton_stream(address: str, camera: Any, starts_s: float, counted_s: float) -> Any:
    """Run a camera as a sequence, as ``many_streams.stream`` does."""
    from tests.benchmarks.many_streams import LEAD_S, Outcome

    images = triton.InferInput("IMAGES", [1, 2, 480, 640, 3], "UINT8")
    images.set_data_from_numpy(np.stack(camera.pair())[None])
    sequence = int.from_bytes(os.urandom(7), "big")
    ages_s: list[float] = []
    steps_s: list[float] = []
    unanswered = asyncio.Semaphore(_CREDIT)

    async def requests() -> AsyncIterator[dict[str, Any]]:
        for index in range(int(camera.rate_hz * (counted_s + LEAD_S))):
            await asyncio.sleep(starts_s - LEAD_S + index / camera.rate_hz - time.monotonic())
            if index and unanswered.locked():
                continue
            await unanswered.acquire()
            captured = triton.InferInput("CAPTURED", [1, 1], "INT64")
            captured.set_data_from_numpy(np.array([[time.monotonic_ns()]]))
            yield {
                "model_name": "stereo",
                "inputs": [images, captured],
                "sequence_id": sequence,
                "sequence_start": index == 0,
            }
        # Triton may leave what it has not answered when the stream ends.
        async with asyncio.timeout(_ANSWER_S):
            for _ in range(_CREDIT):
                await unanswered.acquire()

    async with triton.InferenceServerClient(address) as client:
        async for result, error in client.stream_infer(requests()):
            unanswered.release()
            if error is not None:
                raise error
            captured_ns = result.as_numpy("CAPTURED").item()
            assert result.as_numpy("OFFSET").shape == (1, 480, 640)
            if starts_s <= time.monotonic() < starts_s + counted_s:
                ages_s.append((time.monotonic_ns() - captured_ns) * 1e-9)
                steps_s.append(result.as_numpy("STEP_S").item())
    return Outcome(ages_s, steps_s, int(camera.rate_hz * counted_s))


def _wait_until_ready(port: int, process: subprocess.Popen[bytes], log: Path) -> None:
    deadline_s = time.monotonic() + _START_S
    while time.monotonic() < deadline_s and process.poll() is None:
        try:
            urllib.request.urlopen(f"http://127.0.0.1:{port}/v2/health/ready", timeout=1).close()
        except (urllib.error.URLError, OSError):
            time.sleep(0.2)
        else:
            return
    raise RuntimeError(f"Triton does not start: {log.read_text(errors='replace')[-2000:]}")
