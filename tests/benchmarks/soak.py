"""Random clients against a real server for some minutes: nothing may be left of them.

    python tests/benchmarks/soak.py --minutes 10 --json FILE

The clients open, resume, cancel, die, freeze, stay silent, read slowly, send junk, ask for pairs
and upload sequences, over gRPC and HTTP. Then all of them leave. The benchmark passes (exit code
0) if

- ``opened`` equals ``closed``: the streams, by the server's own count, and none is left;
- no call, descriptor or thread is left that was not there before;
- ``growth_mib`` is small: the resident memory at the end over that at half time;
- the server logged no traceback, and ends on SIGTERM with code 0.

``--secure``: the server has TLS and tokens, its clients belong to three principals, and its
certificate is replaced every few seconds.

``--control`` runs a server that leaks a little with each stream. It must fail.
"""

import argparse
import asyncio
import json
import os
import re
import signal
import ssl
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import httpx

from vergence_proto.instruction_set import instruction_set

sys.path.insert(0, str(Path(__file__).parents[2]))  # for tests.support

from tests.support.certificates import Authority
from tests.support.tokens import TokenFile

REPOSITORY = Path(__file__).parents[2]
CLIENTS = 6
WARM_UP_S = 15.0
SETTLE_S = 60.0
SAMPLES = 40
RENEW_S = 15.0
MOST_GROWTH_MIB = 24.0
# Short times, so that each of them ends many clients in some minutes.
SETTINGS = {
    "MODEL__COLD_ITERATIONS": 1,
    "MODEL__COLD_ITERATIONS_EVERY": 1,
    "MODEL__THREADS": 1,
    "STREAMS__DETACH_GRACE_S": 2,
    "STREAMS__IDLE_TIMEOUT_S": 10,
    "LIMITS__FIRST_MESSAGE_S": 3,
    "LIMITS__SILENT_S": 5,
    "LIMITS__WRITE_S": 3,
    "LIMITS__CONNECTIONS": 64,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Sample:
    """What the server holds at one moment."""

    streams: int
    calls: int
    descriptors: int
    threads: int
    rss_mib: float


class Secrets:
    """The certificate and the tokens of a server, and of its clients."""

    def __init__(self, folder: Path) -> None:
        self._authority = Authority(folder)
        self._issued = self._authority.issue("server")
        self._tokens = TokenFile(folder / "tokens.toml", "ana", "ben", "eve", admins=("root",))

    @property
    def flags(self) -> list[str]:
        return [
            *("--tls-cert", str(self._issued.cert), "--tls-key", str(self._issued.key)),
            *("--tokens", str(self._tokens.path)),
        ]

    @property
    def of_clients(self) -> dict[str, str]:
        tokens = [self._tokens.tokens[name] for name in ("ana", "ben", "eve")]
        return {"VERGENCE_CA": str(self._authority.ca), "SOAK_TOKENS": ",".join(tokens)}

    def of_the_administrator(self) -> dict[str, Any]:
        trusted = ssl.create_default_context(cafile=str(self._authority.ca))
        return {"verify": trusted, "headers": self._tokens.shown("root")}

    async def renew(self) -> None:
        """Replace the certificate, again and again."""
        while True:
            await asyncio.sleep(RENEW_S)
            await asyncio.to_thread(self._authority.issue, "server")


@dataclass(frozen=True, slots=True, eq=False)
class Server:
    process: asyncio.subprocess.Process
    grpc_address: str
    http_address: str
    admin_address: str
    secrets: "Secrets | None"

    async def sample(self) -> Sample:
        about = Path("/proc") / str(self.process.pid)
        metrics = await self.metrics()
        pages = int((about / "statm").read_text().split()[1])
        return Sample(
            streams=int(metrics["vergence_streams_open"]),
            calls=int(metrics.get("vergence_calls_open", 0)),
            descriptors=len(os.listdir(about / "fd")),
            threads=len(os.listdir(about / "task")),
            rss_mib=pages * os.sysconf("SC_PAGE_SIZE") / 2**20,
        )

    async def metrics(self) -> dict[str, float]:
        scheme, options = "http", {}
        if self.secrets is not None:
            scheme, options = "https", self.secrets.of_the_administrator()
        async with httpx.AsyncClient(timeout=60, **options) as http:
            text = (await http.get(f"{scheme}://{self.admin_address}/metrics")).text
        lines = (line.rpartition(" ") for line in text.splitlines() if not line.startswith("#"))
        return {name: float(value) for name, _, value in lines}


async def started(folder: Path, *, leaky: bool, secure: bool) -> Server:
    secrets = Secrets(folder) if secure else None
    module = ["tests.support.leaky_server"] if leaky else ["vergence_service"]
    flags = [] if leaky else ["--grpc-port", "0", "--http-port", "0"]
    flags += secrets.flags if secrets else []
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", *module, *flags),
        cwd=REPOSITORY,
        env={
            **os.environ,
            **{f"VERGENCE_{key}": str(value) for key, value in SETTINGS.items()},
            "VERGENCE_BATCH__DIRECTORY": str(folder / "batch"),
        },
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=(folder / "log").open("wb"),
    )
    assert process.stdout is not None
    line = (await process.stdout.readline()).decode()
    found = re.search(r"grpc=(\S+) http=(\S+)", line)
    assert found, f"the server did not start: {(folder / 'log').read_text()[-2000:]}"
    ready = (await process.stdout.readline()).decode()  # every graph is loaded
    admin_address = ready.strip().rpartition("admin=")[2]
    return Server(process, found[1], found[2], admin_address, secrets)


async def soak(minutes: float, seed: int, *, leaky: bool, secure: bool) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        server = await started(folder, leaky=leaky, secure=secure)
        try:
            figures = await measured(server, minutes, seed)
        finally:
            if server.process.returncode is None:
                server.process.send_signal(signal.SIGTERM)
            code = await asyncio.wait_for(server.process.wait(), 60)
        log = (folder / "log").read_text(errors="replace")
    if "Traceback" in log:
        where = log.index("Traceback")
        print(log[max(where - 500, 0) : where + 4000])  # noqa: T201
    return {**figures, "exit_code": code, "tracebacks": log.count("Traceback")}


async def measured(server: Server, minutes: float, seed: int) -> dict[str, Any]:
    # Whatever the first of its kind makes the server load or open is not a leak.
    await clients_of(server, seed=0, seconds=WARM_UP_S)
    before = await settled(server, None)

    samples: list[Sample] = []

    async def watch() -> None:
        while True:
            await asyncio.sleep(60 * minutes / SAMPLES)
            samples.append(await server.sample())

    beside = [asyncio.create_task(watch())]
    if server.secrets is not None:
        beside.append(asyncio.create_task(server.secrets.renew()))
    opened_before = (await server.metrics())["vergence_streams_opened_total"]
    clients = await clients_of(server, seed=seed, seconds=60 * minutes)
    for task in beside:
        task.cancel()
    await asyncio.wait(beside)
    after = await settled(server, before)
    counted = await server.metrics()
    fifth = max(len(samples) // 5, 1)
    middle = samples[len(samples) // 2 - fifth // 2 :][:fifth]
    growth_mib = median(each.rss_mib for each in samples[-fifth:]) - median(
        each.rss_mib for each in middle
    )
    return {
        "minutes": minutes,
        "opened": int(counted["vergence_streams_opened_total"]),
        "closed": int(counted["vergence_streams_closed_total"]),
        "opened_now": int(counted["vergence_streams_opened_total"] - opened_before),
        "opened_by_clients": clients["opened"],
        "streams_left": after.streams,
        "calls_left": after.calls,
        "descriptors": [before.descriptors, after.descriptors],
        "threads": [before.threads, after.threads],
        "rss_mib": [round(each.rss_mib) for each in samples],
        "growth_mib": round(growth_mib, 1),
        "clients": dict(sorted(clients["seen"].items())),
    }


async def clients_of(server: Server, *, seed: int, seconds: float) -> dict[str, Any]:
    """Let clients act, in a process that ends with them; return what they did."""
    addresses = (server.grpc_address, server.http_address)
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "tests.support.soak_clients", *addresses),
        *map(str, (seed, seconds, CLIENTS)),
        cwd=REPOSITORY,
        env={**os.environ, **(server.secrets.of_clients if server.secrets else {})},
        stdout=asyncio.subprocess.PIPE,
    )
    out, _ = await process.communicate()
    assert process.returncode == 0, "the clients failed; the lines above say why"
    figures: dict[str, Any] = json.loads(out)
    return figures


async def settled(server: Server, before: Sample | None) -> Sample:
    """The server after all have left: as it was ``before``, or after a minute."""
    deadline_s = time.monotonic() + SETTLE_S
    last: Sample | None = None
    while True:
        await asyncio.sleep(3)
        now = await server.sample()
        if time.monotonic() > deadline_s or not now.streams + now.calls:
            same = last is not None and now.descriptors >= last.descriptors
            # gRPC's pool keeps a thread that it added for half a minute.
            as_before = before is None or (
                now.descriptors <= before.descriptors and now.threads <= before.threads
            )
            if (same and as_before) or time.monotonic() > deadline_s:
                return now
        last = now


def faults_of(figures: dict[str, Any]) -> list[str]:
    """What is left behind, in words."""
    found = []
    if figures["opened"] != figures["closed"] or figures["streams_left"]:
        found.append("streams that were opened were not closed")
    if figures["opened_now"] != figures["opened_by_clients"]:
        found.append("clients and server count different numbers of streams")
    if figures["calls_left"]:
        found.append("calls have not ended")
    for what in ("descriptors", "threads"):
        before, after = figures[what]
        if after > before:
            found.append(f"{after - before} {what} are left")
    if figures["growth_mib"] > MOST_GROWTH_MIB:
        found.append(f"memory grew by {figures['growth_mib']} MiB after half of the time")
    if figures["tracebacks"]:
        found.append(f"{figures['tracebacks']} tracebacks in the log")
    if figures["exit_code"]:
        found.append(f"the server ended with code {figures['exit_code']}")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--json", type=Path, help="write the figures there")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--secure", action="store_true", help="with TLS and tokens")
    parser.add_argument("--control", action="store_true", help="serve with leaks: it must fail")
    args = parser.parse_args()
    figures = asyncio.run(soak(args.minutes, args.seed, leaky=args.control, secure=args.secure))
    figures = {"isa": instruction_set(), "control": args.control, "secure": args.secure, **figures}
    faults = faults_of(figures)
    figures["faults"] = faults
    for name, value in figures.items():
        print(f"{name:18} {value}")  # noqa: T201
    if args.json:
        args.json.write_text(json.dumps(figures, indent=1) + "\n")
    sys.exit(bool(faults))


if __name__ == "__main__":
    main()
