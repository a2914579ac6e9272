"""A gRPC server without Vergence's service: a loop over the model, in order of arrival.

``python plain_loop.py WEIGHTS THREADS`` serves 640x480 streams. Each message is the time of capture
and two raw images; the answer is that time, the seconds of the step, and the map.
"""

import asyncio
import struct
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import grpc
import numpy as np

from vergence_proto.geometry import Pose, RectifiedRig
from vergence_service.inference.engines import load_model
from vergence_service.inference.model import Step, StepResult, StereoView

_METHOD = "/plain.Loop/Step"
_HEAD = struct.Struct("<qd")
_SIZE = (480, 640, 3)
_RIG = RectifiedRig(640, 480, 512.0, 512.0, 319.5, 319.5, 239.5, 0.1)
_LARGE = [("grpc.max_receive_message_length", -1), ("grpc.use_local_subchannel_pool", 1)]
_CREDIT = 2


@contextmanager
def plain_loop(weights: Path, threads: int) -> Iterator[tuple[str, int]]:
    """Yield the address and the process id of a server."""
    command = [sys.executable, __file__, str(weights), str(threads)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield process.stdout.readline().strip(), process.pid
        finally:
            process.terminate()


async def plain_stream(address: str, camera: Any, starts_s: float, counted_s: float) -> Any:
    """Run a camera, as ``many_streams.stream`` does."""
    from tests.benchmarks.many_streams import LEAD_S, Outcome

    left, right = camera.pair()
    images = left.tobytes() + right.tobytes()
    ages_s: list[float] = []
    steps_s: list[float] = []
    unanswered = 0
    async with grpc.aio.insecure_channel(address, options=_LARGE) as channel:
        start: Any = channel.stream_stream
        call = start(_METHOD)()

        async def read() -> None:
            nonlocal unanswered
            async for answer in call:
                unanswered -= 1
                capture_ns, step_s = _HEAD.unpack_from(answer)
                if starts_s <= time.monotonic() < starts_s + counted_s:
                    ages_s.append((time.monotonic_ns() - capture_ns) * 1e-9)
                    steps_s.append(step_s)

        reading = asyncio.create_task(read())
        for index in range(int(camera.rate_hz * (counted_s + LEAD_S))):
            await asyncio.sleep(starts_s - LEAD_S + index / camera.rate_hz - time.monotonic())
            if unanswered < _CREDIT:
                unanswered += 1
                await call.write(_HEAD.pack(time.monotonic_ns(), 0.0) + images)
        await call.done_writing()
        await reading
    return Outcome(ages_s, steps_s, int(camera.rate_hz * counted_s))


async def _serve(weights: Path, threads: int) -> None:
    model = load_model(
        weights, "lite", engine="auto", providers=["cpu"], threads=threads, allow_spinning=False
    )
    iterations = model.card.iterations_at_most(1)
    model.warm_up(iterations, iterations)
    pool = ThreadPoolExecutor(model.max_concurrent_steps)

    def timed(step: Step) -> tuple[StepResult, float]:
        started_s = time.perf_counter()
        [result] = model.step([step])
        return result, time.perf_counter() - started_s

    async def steps(requests: AsyncIterator[bytes], _: object) -> AsyncIterator[bytes]:
        state = None
        async for request in requests:
            capture_ns, _ = _HEAD.unpack_from(request)
            images = np.frombuffer(request, np.uint8, offset=_HEAD.size).reshape(2, *_SIZE)
            view = StereoView(images[0], images[1], _RIG, capture_ns, Pose.identity())

            result, step_s = await asyncio.get_running_loop().run_in_executor(
                pool, timed, Step(view, state, iterations)
            )
            state = result.state
            yield _HEAD.pack(capture_ns, step_s) + result.offset_px.astype(np.float16).tobytes()

    service, method = _METHOD.split("/")[1:]
    handler = grpc.method_handlers_generic_handler(
        service, {method: grpc.stream_stream_rpc_method_handler(steps)}
    )
    server = grpc.aio.server(options=_LARGE)
    server.add_generic_rpc_handlers((handler,))
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    sys.stdout.write(f"127.0.0.1:{port}\n")
    sys.stdout.flush()
    await server.wait_for_termination()


if __name__ == "__main__":
    asyncio.run(_serve(Path(sys.argv[1]), int(sys.argv[2])))
