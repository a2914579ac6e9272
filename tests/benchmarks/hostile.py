"""A server under hostile input over every transport, beside two streams of other processes.

    python tests/benchmarks/hostile.py --inputs 10000 --json FILE

Damaged and expensive frames, messages, images and archives go to a real server process over gRPC,
HTTP and, if it is installed, Zenoh. Beside them, a *neighbour* sends the same lossless frames as it
did alone, and a *healthy* live stream sends 640x480 at 30 Hz; each is a process of its own. The
benchmark prints:

- ``crashes``: how often the server ended, or logged an error that it did not expect.
- ``leaks``: streams, calls and descriptors that are still there 30 s after all clients have left,
  beyond those that were there after a first, short attack.
- ``peak_mib``: the largest resident memory under attack, minus that of the idle server.
- ``neighbour_identical``: every answer of the neighbour had the bytes that it had alone.
- ``age_ratio``: p99 of the age of the healthy stream's answers, under attack over alone.
"""

import argparse
import asyncio
import collections
import contextlib
import importlib.util
import json
import random
import socket
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any

import httpx

sys.path.insert(0, str(Path(__file__).parents[2]))  # for tests.support

from tests.support import hostile_inputs
from tests.support.hostile_clients import (
    OPENED,
    GrpcAttacker,
    HttpAttacker,
    Outcome,
    healthy_stream,
    neighbour_stream,
    zenoh_attacker,
)
from vergence_proto.instruction_set import instruction_set

SECONDS_ALONE = 12.0
SETTLE_S = 30.0
WARM_UP = 200  # inputs
# Inputs of each kind in a hundred, of those that the transport has.
SHARES = {
    "grpc frame": 40,
    "grpc opening": 14,
    "grpc method": 5,
    "http frame": 10,
    "http opening": 4,
    "http method": 4,
    "http pair": 5,
    "http archive": 6,
    "zenoh frame": 8,
    "zenoh query": 3,
    "largest step": 1,
}
ROLES = {"neighbour": neighbour_stream, "healthy": healthy_stream}
LARGEST_SIZES = ((2000, 2000), (4096, 960), (960, 4096), (1280, 960))


def free_zenoh_endpoint() -> str | None:
    """Return an endpoint for the server to listen on, or None if Zenoh is not installed."""
    if importlib.util.find_spec("zenoh") is None:
        return None
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


class Server:
    """A server process in a scratch folder."""

    def __init__(
        self, process: asyncio.subprocess.Process, folder: Path, addresses: dict[str, str]
    ):
        self.pid = process.pid
        self.addresses = addresses
        self._process = process
        self._log = folder / "log"

    @property
    def ended(self) -> bool:
        return self._process.returncode is not None

    @property
    def log(self) -> str:
        return self._log.read_text(errors="replace")

    @property
    def errors(self) -> int:
        return self.log.count(" ERROR ")

    def memory_bytes(self, which: str) -> int:
        """VmRSS, or VmHWM: the most since :meth:`forget_peak`."""
        status = Path(f"/proc/{self.pid}/status").read_text()
        [line] = [line for line in status.splitlines() if line.startswith(which)]
        return 1024 * int(line.split()[1])

    def forget_peak(self) -> None:
        Path(f"/proc/{self.pid}/clear_refs").write_text("5")

    def descriptors(self) -> int:
        return len([*Path(f"/proc/{self.pid}/fd").iterdir()])

    async def metric(self, name: str) -> float:
        async with httpx.AsyncClient() as client:
            text = (await client.get(f"http://{self.addresses['admin']}/metrics")).text
        [value] = [line.split()[1] for line in text.splitlines() if line.startswith(f"{name} ")]
        return float(value)


@contextlib.asynccontextmanager
async def serving(zenoh_endpoint: str | None) -> AsyncIterator[Server]:
    """A server; it is idle and has loaded everything."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        settings = [
            f'[batch]\ndirectory = "{folder / "batch"}"',
            "[streams]\ndetach_grace_s = 2.0\nidle_timeout_s = 10.0\nidle_notice_s = 1.0",
        ]
        if zenoh_endpoint:
            settings.append(f'[zenoh]\nenabled = true\nlisten = ["{zenoh_endpoint}"]')
        (folder / "config.toml").write_text("\n".join(settings))
        with (folder / "log").open("wb") as log:
            process = await asyncio.create_subprocess_exec(
                *(sys.executable, "-m", "vergence_service", "--grpc-port", "0"),
                *("--http-port", "0", "--config", str(folder / "config.toml")),
                stdout=asyncio.subprocess.PIPE,
                stderr=log,
            )
        assert process.stdout is not None
        try:
            words = (await process.stdout.readline()).decode().split()
            addresses = dict(word.split("=", 1) for word in words if "=" in word)
            assert "grpc" in addresses, (folder / "log").read_text()
            ready = (await process.stdout.readline()).decode()
            assert "ready" in ready
            addresses["admin"] = ready.strip().rpartition("admin=")[2]
            yield Server(process, folder, addresses)
        finally:
            if process.returncode is None:
                process.terminate()
            await process.wait()


class Child:
    """This file in a process of its own, with one stream, until it is stopped."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self._process = process

    @classmethod
    async def start(cls, role: str, server: Server) -> "Child":
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, __file__, "--role", role, "--address", server.addresses["grpc"]),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
        )
        assert process.stdout is not None
        assert await asyncio.wait_for(process.stdout.readline(), 60) == OPENED
        return cls(process)

    async def stop(self) -> Any:
        """Let it end; return what it measured."""
        output, _ = await asyncio.wait_for(self._process.communicate(b""), 60)
        return json.loads(output)


async def attack(
    server: Server, args: argparse.Namespace, zenoh_endpoint: str | None, *, inputs: int
) -> Outcome:
    """Send so many inputs, a few at a time."""
    seen: Outcome = collections.Counter()
    async with contextlib.AsyncExitStack() as stack:
        grpc_calls = [
            await stack.enter_async_context(GrpcAttacker(server.addresses["grpc"], seen))
            for _ in range(args.clients)
        ]
        http = await stack.enter_async_context(HttpAttacker(server.addresses["http"], seen))
        zenoh = await stack.enter_async_context(zenoh_attacker(zenoh_endpoint, seen))
        shares = {kind: share for kind, share in SHARES.items() if zenoh or "zenoh" not in kind}
        left = inputs

        async def client(index: int) -> None:
            nonlocal left
            chance = random.Random(f"{args.seed} {inputs} {index}")
            calls = grpc_calls[index]
            senders: dict[str, Callable[[], Awaitable[None]]] = {
                "grpc frame": lambda: calls.frame(chance),
                "grpc opening": lambda: calls.opening(hostile_inputs.opening(chance)),
                "grpc method": lambda: calls.method(chance),
                "http frame": lambda: http.frame(chance, index),
                "http opening": lambda: http.opening(hostile_inputs.opening(chance)),
                "http method": lambda: http.method(chance),
                "http pair": lambda: http.pair(hostile_inputs.pair(chance)),
                "http archive": lambda: http.archive(*hostile_inputs.archive(chance)),
                "largest step": lambda: calls.largest_step(*chance.choice(LARGEST_SIZES)),
            }
            if zenoh is not None:
                senders["zenoh frame"] = lambda: zenoh.frame(chance, index)
                senders["zenoh query"] = lambda: zenoh.query(chance)
            while left > 0 and not server.ended:
                left -= 1
                [kind] = chance.choices([*shares], [*shares.values()])
                seen[f"sent: {kind}"] += 1
                await senders[kind]()

        async with asyncio.TaskGroup() as tasks:
            for index in range(args.clients):
                tasks.create_task(client(index))
    return seen


async def left_behind(server: Server, descriptors: int) -> dict[str, int]:
    """Wait until everything is gone; return what is still there after 30 s."""
    until_s = time.monotonic() + SETTLE_S
    while True:
        left = {
            "streams": int(await server.metric("vergence_streams_open")),
            "calls": int(await server.metric("vergence_calls_open")),
            "descriptors": max(server.descriptors() - descriptors, 0),
        }
        if not any(left.values()) or time.monotonic() > until_s:
            return left
        await asyncio.sleep(1)


async def measure(args: argparse.Namespace) -> dict[str, Any]:
    endpoint = free_zenoh_endpoint()
    async with serving(endpoint) as server:
        idle_bytes = server.memory_bytes("VmRSS")
        server.forget_peak()
        quiet: dict[str, Any] = {}
        for role in ROLES:  # one after the other
            child = await Child.start(role, server)
            await asyncio.sleep(SECONDS_ALONE)
            quiet[role] = await child.stop()
        # gRPC and Zenoh keep descriptors for as many clients as there were at once. So some inputs
        # come before the descriptors are counted: what later ones leave behind is lost.
        await attack(server, args, endpoint, inputs=WARM_UP)
        await left_behind(server, 0)
        descriptors = server.descriptors()
        children = {role: await Child.start(role, server) for role in ROLES}
        started_s = time.monotonic()
        seen = await attack(server, args, endpoint, inputs=args.inputs)
        seconds = time.monotonic() - started_s
        if server.ended:
            raise SystemExit("the server ended under attack: crashes 1")
        beside = {role: await child.stop() for role, child in children.items()}
        left = await left_behind(server, descriptors)
        crashes, log = server.errors, server.log
        if args.log:
            args.log.write_text(log)
        peak_bytes, after_bytes = server.memory_bytes("VmHWM"), server.memory_bytes("VmRSS")
    answers = [quiet["neighbour"]["answers"], beside["neighbour"]["answers"]]
    compared = min(map(len, answers))
    return {
        "isa": instruction_set(),
        "inputs": args.inputs,
        "seconds": round(seconds, 1),
        "crashes": crashes,
        "leaks": sum(left.values()),
        "left": left,
        "idle_mib": idle_bytes >> 20,
        "peak_mib": (peak_bytes - idle_bytes) >> 20,
        "kept_mib": (after_bytes - idle_bytes) >> 20,
        "neighbour_identical": compared > 0 and answers[0][:compared] == answers[1][:compared],
        "neighbour_answers": compared,
        "age_ratio": round(beside["healthy"]["p99_ms"] / quiet["healthy"]["p99_ms"], 2),
        "healthy_alone": quiet["healthy"],
        "healthy_under_attack": beside["healthy"],
        "log_lines": len(log.splitlines()),
        "seen": dict(sorted(seen.items())),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--json", type=Path, help="write the figures there")
    parser.add_argument("--log", type=Path, help="write the server's log there")
    parser.add_argument("--inputs", type=int, default=10_000)
    parser.add_argument("--clients", type=int, default=4, help="attackers at the same time")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--role", choices=[*ROLES], help=argparse.SUPPRESS)
    parser.add_argument("--address", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.role:
        print(json.dumps(asyncio.run(ROLES[args.role](args.address))))  # noqa: T201
        return
    figures = asyncio.run(measure(args))
    for name, value in figures.items():
        print(f"{name:22} {value}")  # noqa: T201
    if args.json:
        args.json.write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main()
