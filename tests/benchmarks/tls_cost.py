"""Measure what TLS and a token cost for each frame.

    python tests/benchmarks/tls_cost.py --json FILE

Three real server processes run `lite`: one without TLS, one with it, one with TLS and tokens. A
session of the SDK with each sends one frame at a time, in turn, over loopback gRPC, so that other
work on the machine slows all three alike. There is a row for two formats: ``off_machine``, that of
the SDK for a server elsewhere (grey JPEG of quality 80 up, every second pixel to 1/16 px down), and
``raw``. Each row has:

- ``plain_ms``: median time from submitting a frame to its map, without the step in the model.
- ``tls_ms``: median of what a frame takes longer with TLS than its neighbour in time without it.
- ``token_ms``: median of what a frame takes longer with TLS and a token than with TLS alone.

It passes (exit code 0) if TLS costs less than 1 ms off the machine, and a token less than 0.1 ms.
"""

import argparse
import asyncio
import json
import os
import sys
import tempfile
import time
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vergence import (
    DepthClient,
    DepthSession,
    ImageEncoding,
    OutputFormat,
    Pose,
    RectifiedRig,
)
from vergence_proto.instruction_set import instruction_set

sys.path.insert(0, str(Path(__file__).parents[2]))  # for tests.support

from tests.support.certificates import Authority
from tests.support.tokens import TokenFile

KINDS = ("plain", "tls", "token")
MOST_TLS_MS = 1.0
MOST_TOKEN_MS = 0.1
WARM_UP = 10  # frames
RIG = RectifiedRig(640, 480, 512.0, 512.0, 319.5, 319.5, 239.5, 0.1)
FORMATS: dict[str, dict[str, Any]] = {
    "off_machine": {
        "jpeg_quality": 80,
        "output": OutputFormat(denominator=16, map_step=2),
    },
    "raw": {"encoding": ImageEncoding.RAW},
}


@dataclass(frozen=True, slots=True)
class Server:
    address: str
    token: str | None
    ca: Path | None

    def client(self) -> DepthClient:
        scheme = "grpc" if self.ca is None else "grpcs"
        return DepthClient(f"{scheme}://{self.address}", token=self.token, ca=self.ca)


@asynccontextmanager
async def serving(kind: str, folder: Path) -> AsyncIterator[Server]:
    flags: list[str] = []
    token = ca = None
    if kind != "plain":
        authority = Authority(folder)
        issued, ca = authority.issue(kind), authority.ca
        flags += ["--tls-cert", str(issued.cert), "--tls-key", str(issued.key)]
    if kind == "token":
        file = TokenFile(folder / "tokens.toml", "ana")
        token = file.tokens["ana"]
        flags += ["--tokens", str(file.path)]
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "vergence_service", "--grpc-port", "0", "--http-port", "0", *flags),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.DEVNULL,
        env={**os.environ, "VERGENCE_BATCH__DIRECTORY": str(folder / "batch")},
    )
    assert process.stdout is not None
    try:
        _, address, _ = (await process.stdout.readline()).decode().split()
        await process.stdout.readline()  # every graph is loaded
        yield Server(address.removeprefix("grpc="), token, ca)
    finally:
        process.terminate()
        await process.wait()


async def frame(session: DepthSession, pair: tuple[Any, Any]) -> float:
    """Step a frame; return its time without the model, in ms."""
    started_s = time.perf_counter()
    assert session.submit(*pair, Pose.identity())
    result = await anext(aiter(session))
    return 1e3 * (time.perf_counter() - started_s - result.timings.model_s)


async def measure(servers: dict[str, Server], frames: int, **options: Any) -> dict[str, float]:
    noise = np.random.default_rng(0).integers(0, 256, (480, 652, 3), np.uint8)
    smooth = np.repeat(np.repeat(noise[::8, ::8], 8, axis=0), 8, axis=1)[:480]
    pair = smooth[:, :640].copy(), smooth[:, 12:652].copy()
    async with AsyncExitStack() as stack:
        sessions: dict[str, DepthSession] = {}
        for kind, server in servers.items():
            client = await stack.enter_async_context(server.client())
            session = client.open_session(RIG, link="fixed", **options)
            sessions[kind] = await stack.enter_async_context(session)
        for _ in range(WARM_UP):
            for session in sessions.values():
                await frame(session, pair)
        taken = np.empty((frames, len(KINDS)))
        for index in range(frames):
            for column in np.roll(range(len(KINDS)), index):  # nobody is always the first
                taken[index, column] = await frame(sessions[KINDS[column]], pair)
    return {
        "plain_ms": float(np.median(taken[:, 0])),
        "tls_ms": float(np.median(taken[:, 1] - taken[:, 0])),
        "token_ms": float(np.median(taken[:, 2] - taken[:, 1])),
    }


async def rows(frames: int) -> dict[str, dict[str, float]]:
    figures: dict[str, dict[str, float]] = {}
    async with AsyncExitStack() as stack:
        servers: dict[str, Server] = {}
        for kind in KINDS:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            servers[kind] = await stack.enter_async_context(serving(kind, folder))
        for name, options in FORMATS.items():
            figures[name] = await measure(servers, frames, **options)
            values = " ".join(f"{key} {value:.3f}" for key, value in figures[name].items())
            print(f"{name:12} {values}", flush=True)  # noqa: T201
    return figures


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--json", type=Path, help="write the figures there")
    parser.add_argument("--frames", type=int, default=300, help="of each server, and format")
    args = parser.parse_args()
    print(f"isa {instruction_set()}")  # noqa: T201
    figures = asyncio.run(rows(args.frames))
    if args.json:
        settings = {"frames": args.frames, "isa": instruction_set()}
        args.json.write_text(json.dumps({**settings, **figures}, indent=1) + "\n")
    usual = figures["off_machine"]
    return int(usual["tls_ms"] >= MOST_TLS_MS or usual["token_ms"] >= MOST_TOKEN_MS)


if __name__ == "__main__":
    sys.exit(main())
