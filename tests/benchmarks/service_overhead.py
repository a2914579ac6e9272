"""Measure what the service adds to its model: transport, codec and queueing.

    python tests/benchmarks/service_overhead.py --json FILE

Every round measures each of these once, so that all of them share the machine's load. The benchmark
prints medians.

- ``model_ms``: a warm step of the model in this process, with nothing around it.
- ``service_ms``: the same step through the SDK, loopback gRPC and a real server process, one frame
  at a time, from the arrays of the images to the array of the disparity.
- ``overhead_ms``: ``service_ms - model_ms``.
- ``bare_grpc_ms``: messages of the same sizes through a gRPC server that only echoes.
- ``pipelined_ms``: time per frame with as many frames in flight as the credit allows.
"""

import argparse
import asyncio
import json
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import grpc
import numpy as np

from vergence import Delivery, DepthClient, DepthSession, ImageEncoding
from vergence_proto import codec
from vergence_proto.geometry import Pose, RectifiedRig
from vergence_proto.instruction_set import instruction_set
from vergence_proto.types import Image, OutputFormat, PoseSample, StereoFrame
from vergence_service.inference.engines import load_model
from vergence_service.inference.model import RecurrentState, Step, StereoView
from vergence_service.inference.onnx_model import packaged_weights_dir

RIG = RectifiedRig(640, 480, 500.0, 500.0, 319.5, 319.5, 239.5, 0.1)
DISPARITY_PX = 12
STEP_M = 0.01
ECHO = "/vergence.benchmarks.Echo/Echo"


Scene = list[tuple[Image, Image, Pose]]


def make_scene(frames: int) -> Scene:
    """Make frames of a camera that moves along a textured wall: each is new, each pose is true."""
    depth_m = RIG.fx * RIG.baseline_m / DISPARITY_PX
    step_px = round(RIG.fx * STEP_M / depth_m)
    noise = np.random.default_rng(0).integers(0, 256, (480, 640 + 64, 3), np.uint8)
    wall = cv2.GaussianBlur(noise, (0, 0), 1.5)
    low, high = int(wall.min()), int(wall.max())
    stretched: Image = ((wall.astype(np.float32) - low) * (255 / (high - low))).astype(np.uint8)
    scene: Scene = []
    for index in range(frames):
        start = step_px * (index % 16)  # forward, and back in one jump
        left, right = (stretched[:, at : at + 640].copy() for at in (start, start + DISPARITY_PX))
        position_m = np.array([start * depth_m / RIG.fx, 0.0, 0.0])
        scene.append((left, right, Pose(np.eye(3), position_m)))
    return scene


@asynccontextmanager
async def serving(threads: int) -> AsyncIterator[str]:
    """A real server process; yields its gRPC address."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "vergence_service"),
        *("--grpc-port", "0", "--http-port", "0", "--threads", str(threads)),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.DEVNULL,
    )
    assert process.stdout is not None
    try:
        _, grpc_address, _ = (await process.stdout.readline()).decode().split()
        yield grpc_address.removeprefix("grpc=")
    finally:
        process.terminate()
        await process.wait()


@asynccontextmanager
async def echoing(answer_bytes: int) -> AsyncIterator[str]:
    """Start a gRPC server process that answers every message with ``answer_bytes`` bytes."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, __file__, "--echo", str(answer_bytes)),
        stdout=asyncio.subprocess.PIPE,
    )
    assert process.stdout is not None
    try:
        yield (await process.stdout.readline()).decode().strip()
    finally:
        process.terminate()
        await process.wait()


async def echo(answer_bytes: int) -> None:
    answer = bytes(answer_bytes)

    async def serve_stream(requests: AsyncIterator[bytes], _: object) -> AsyncIterator[bytes]:
        async for _request in requests:
            yield answer

    handler = grpc.method_handlers_generic_handler(
        ECHO.split("/")[1], {"Echo": grpc.stream_stream_rpc_method_handler(serve_stream)}
    )
    server = grpc.aio.server(options=[("grpc.max_receive_message_length", -1)])
    server.add_generic_rpc_handlers((handler,))
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    print(f"127.0.0.1:{port}", flush=True)  # noqa: T201
    await server.wait_for_termination()


class BareModel:
    """Steps the model with its recurrent state, as the server does."""

    def __init__(self, threads: int) -> None:
        self._model = load_model(
            packaged_weights_dir(),
            "lite",
            engine="auto",  # the one that the server takes
            providers=["cpu"],
            threads=threads,
            allow_spinning=False,
        )
        self._iterations = self._model.card.iterations_at_most(1)
        self._state: RecurrentState | None = None

    def step_s(self, left: Image, right: Image, world_from_left: Pose, capture_ns: int) -> float:
        view = StereoView(left, right, RIG, capture_ns, world_from_left)
        started_s = time.perf_counter()
        [result] = self._model.step([Step(view, self._state, self._iterations)])
        self._state = result.state
        return time.perf_counter() - started_s


async def measure(args: argparse.Namespace) -> dict[str, float]:
    scene = make_scene(args.warm_up + args.rounds)
    left, right, pose = scene[0]
    encoding = ImageEncoding(args.encoding)
    request = codec.frame_to_request(
        StereoFrame(1, 1, left, right, PoseSample(pose)), encoding=encoding
    )
    model = BareModel(args.threads)
    async with (
        serving(args.threads) as address,
        DepthClient(f"grpc://{address}") as client,
        client.open_session(RIG, delivery=Delivery.EVERY, encoding=encoding) as session,
    ):
        first = await session.step(left, right, pose)
        # A session asks for this by default if the server is on its machine.
        answer = codec.disparity_to_proto(first, OutputFormat(compressed=False)).ByteSize()
        async with (
            echoing(answer) as echo_address,
            grpc.aio.insecure_channel(
                echo_address, options=[("grpc.max_receive_message_length", -1)]
            ) as channel,
        ):
            connect: Any = channel.stream_stream  # without serialisers, messages are bytes
            bare = connect(ECHO)()
            rounds: list[dict[str, float]] = []
            for index, (left, right, pose) in enumerate(scene):
                model_s = model.step_s(left, right, pose, index)
                started_s = time.perf_counter()
                result = await session.step(left, right, pose)
                service_s = time.perf_counter() - started_s
                started_s = time.perf_counter()
                await bare.write(request)
                await bare.read()
                bare_s = time.perf_counter() - started_s
                rounds.append(
                    {
                        "model": model_s,
                        "service": service_s,
                        "bare_grpc": bare_s,
                        "server_decode": result.timings.decode_s,
                        "server_queue": result.timings.queue_s,
                        "server_model": result.timings.model_s,
                        "server_encode": result.timings.encode_s,
                        "server_total": result.timings.total_s,
                    }
                )
            bare.cancel()
        pipelined_s = await pipelined(session, scene)
    counted = rounds[args.warm_up :]
    figures = {f"{name}_ms": 1e3 * median(row[name] for row in counted) for name in counted[0]}
    figures["overhead_ms"] = figures["service_ms"] - figures["model_ms"]
    figures["pipelined_ms"] = pipelined_s / len(scene) * 1e3
    figures["overhead_pct"] = 100 * figures["overhead_ms"] / figures["model_ms"]
    return figures


async def pipelined(session: DepthSession, scene: Scene) -> float:
    started_s = time.perf_counter()
    await asyncio.gather(*(session.step(*frame) for frame in scene))
    return time.perf_counter() - started_s


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--json", type=Path, help="write the figures there")
    parser.add_argument("--rounds", type=int, default=60)
    parser.add_argument("--warm-up", type=int, default=10, help="rounds that are not counted")
    parser.add_argument("--threads", type=int, default=2, help="of the model, here and there")
    parser.add_argument("--encoding", choices=[e.value for e in ImageEncoding], default="raw")
    parser.add_argument("--echo", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.echo is not None:
        asyncio.run(echo(args.echo))
        return
    figures = {name: round(value, 3) for name, value in asyncio.run(measure(args)).items()}
    print(f"isa {instruction_set()}")  # noqa: T201
    for name, value in figures.items():
        print(f"{name:18} {value:9.3f}")  # noqa: T201
    if args.json:
        args.json.write_text(json.dumps({"isa": instruction_set(), **figures}, indent=1) + "\n")


if __name__ == "__main__":
    main()
