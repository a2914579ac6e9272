"""Simulate a fleet from the measured costs of one server, and do the arithmetic of its parts.

    python tests/benchmarks/snapshot_cost.py --json snapshots.json
    python tests/benchmarks/fleet_real.py --streams 4 --hz 5 --json real.json
    python tests/benchmarks/fleet.py --snapshots snapshots.json --real real.json --json FILE

A real server runs ``lite`` on this machine, with cameras of 640x480 over loopback. It gives the
time of a step, alone and beside others, how the times are spread, and the server's CPU time for a
frame. A simulation (tests/support/simulated_fleet.py) then has streams that wait for lanes.

- ``checked``: the simulation beside the same streams on the real server. The last row has set the
  time of a step beside others; the rows before it are predictions. Rates in Hz, ages in ms.
- ``bytes``: of a frame and a map on the wire, as a live session with a server elsewhere has them
  (grey JPEG 80, every second pixel of the map), for the bundled sequence.
- ``capacity``: the most streams of one rate on one server of which every one has 95 % of its
  frames answered. Here the clients are elsewhere: a lane's time is the server's CPU time.
- ``spread``: streams of the fullest server over the mean, by servers and by the points of Envoy's
  ring; and with a bound on it (hash_balance_factor).
- ``kill``: one of ``--servers`` dies at 70 % of their capacity.
- ``growth``: streams arrive for ten minutes, and a rule as that of Kubernetes adds servers every
  15 s for 70 % of the capacity; streams stay where they are. ``shed``: frames without a map.
- ``headsets``: what a thousand of them need.
"""

import argparse
import asyncio
import json
import os
import sys
import time
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vergence import Delivery, DepthClient, ImageEncoding, OutputFormat
from vergence.cli.demo import bundled_sample
from vergence.cli.sources import source_at
from vergence_proto.instruction_set import instruction_set
from vergence_service.inference.onnx_model import packaged_weights_dir

sys.path.insert(0, str(Path(__file__).parents[2]))  # for tests.support

from tests.benchmarks.many_streams import Camera, Outcome, Server, serving, together
from tests.support.simulated_fleet import Costs, SimulatedFleet

LANES = 2
COUNTS = (1, 2, 4, 8, 16)  # the last one saturates the server
SECONDS = 6.0
RATES_HZ = (10.0, 15.0, 30.0)
ANSWERED = 0.95
LOAD = 0.7
SETTLE_S, SIMULATED_S = 2.0, 12.0
HEADSETS = 1000


def percentiles_ms(ages_s: Any) -> dict[str, float]:
    if not len(ages_s):
        return {"age_p50_ms": np.nan, "age_p99_ms": np.nan}
    p50, p99 = np.percentile(np.asarray(ages_s), [50, 99])
    return {"age_p50_ms": 1e3 * p50, "age_p99_ms": 1e3 * p99}


def samples(times_s: NDArray[np.float64], *, mean_s: float | None = None) -> tuple[float, ...]:
    """Return a hundred times with the spread of these. ``mean_s``: with another mean."""
    factor = 1.0 if mean_s is None else mean_s / times_s.mean()
    return tuple(np.quantile(factor * times_s, np.linspace(0.005, 0.995, 100)))


async def measured(rate_hz: float) -> tuple[Costs, float, dict[str, dict[str, float]]]:
    """Return the costs with clients on this machine, the server's CPU time, and the rows."""
    rows: dict[str, dict[str, float]] = {}
    runs: dict[int, tuple[list[Outcome], float]] = {}
    async with serving(packaged_weights_dir(), LANES) as server:
        for count in COUNTS:
            cameras = [Camera(rate_hz=rate_hz)] * count
            outcomes, cpu_s = runs[count] = await together(server, cameras, seconds=SECONDS)
            ages_s = np.concatenate([each.ages_s for each in outcomes])
            rows[str(count)] = {
                "hz": len(ages_s) / SECONDS,
                **percentiles_ms(ages_s),
                "cpu_ms": 1e3 * cpu_s / len(ages_s),
            }
    [lone] = runs[1][0]
    full, cpu_s = runs[COUNTS[-1]]
    steps_s = np.concatenate([each.steps_s for each in full])
    answers = sum(len(each.ages_s) for each in full)
    costs = Costs(
        alone_s=samples(np.array(lone.steps_s)),
        beside_s=samples(steps_s, mean_s=LANES * SECONDS / answers),
        transport_s=float(np.median(lone.ages_s) - np.median(lone.steps_s)),
        gap_s=0.0,
        start_s=0.0,
    )
    return costs, cpu_s / answers, rows


def steady(fleet: SimulatedFleet, rates_hz: list[float]) -> dict[str, float]:
    """Run streams, and count after a lead."""
    for hz in rates_hz:
        fleet.open(hz)
    fleet.run(SETTLE_S)
    taken = {each: each.taken for each in fleet.streams}
    answered = {each: each.answered for each in fleet.streams}
    fleet.run(SETTLE_S + SIMULATED_S)
    shares = [
        (each.answered - answered[each]) / max(each.taken - taken[each], 1)
        for each in fleet.streams
    ]
    ages_s = [age_s for at_s, age_s in fleet.ages_s if at_s >= SETTLE_S]
    return {"hz": len(ages_s) / SIMULATED_S, **percentiles_ms(ages_s), "least": min(shares)}


def capacity(costs: Costs, hz: float) -> int:
    """Return the most streams of one server of which all have their frames answered."""
    count = 0
    while True:
        fleet = SimulatedFleet(costs, servers=1, lanes=LANES)
        if steady(fleet, [hz] * (count + 1))["least"] < ANSWERED:
            return count
        count += 1


def fullest(costs: Costs, servers: int, each: int, *, points: int, balance: float) -> float:
    """Return the streams of the fullest server over the mean; the mean of eight draws."""
    ratios = []
    for seed in range(8):
        fleet = SimulatedFleet(
            costs, servers=servers, lanes=LANES, points=points, balance=balance, seed=seed
        )
        for _ in range(servers * each):
            fleet.open(1.0)
        ratios.append(max(len(server.streams) for server in fleet.servers) / each)
    return float(np.mean(ratios))


def killed(costs: Costs, servers: int, streams: int, hz: float, balance: float) -> dict[str, float]:
    fleet = SimulatedFleet(costs, servers=servers, lanes=LANES, points=65536, balance=balance)
    for _ in range(streams):
        fleet.open(hz)
    died_s = 10.0
    fleet.run(died_s)
    for stream in fleet.streams:
        stream.longest_gap_s = 0.0
    moved = set(fleet.servers[0].streams)
    fleet.kill(fleet.servers[0])
    fleet.run(died_s + 10.0)
    before_s = [age for at_s, age in fleet.ages_s if SETTLE_S <= at_s < died_s]
    after_s = [age for at_s, age in fleet.ages_s if at_s >= died_s + costs.gap_s + 1.0]
    return {
        "streams": streams,
        "moved": len(moved),
        "gap_max_ms": 1e3 * max((each.longest_gap_s for each in moved), default=0.0),
        "others_gap_max_ms": 1e3 * max(s.longest_gap_s for s in fleet.streams if s not in moved),
        "age_p99_before_ms": percentiles_ms(before_s)["age_p99_ms"],
        "age_p99_after_ms": percentiles_ms(after_s)["age_p99_ms"],
    }


def growth(costs: Costs, per_server: int, hz: float, balance: float) -> dict[str, float]:
    """Let streams arrive as by chance, three times as many as one server carries."""
    fleet = SimulatedFleet(costs, servers=1, lanes=LANES, points=65536, balance=balance)
    arrivals, until_s = 8 * per_server, 600.0
    times_s = np.sort(np.random.default_rng(0).uniform(0.0, until_s, arrivals))
    for time_s in times_s:
        fleet.at(float(time_s), partial(fleet.open, hz))
    wanted = 1

    def scale() -> None:
        nonlocal wanted
        needed = int(np.ceil(len(fleet.streams) / (LOAD * per_server)))
        while wanted < needed:
            wanted += 1
            fleet.add()

    for time_s in np.arange(15.0, until_s, 15.0):
        fleet.at(float(time_s), scale)
    fleet.run(until_s)
    taken, answered = sum(s.taken for s in fleet.streams), sum(s.answered for s in fleet.streams)
    return {
        "streams": arrivals,
        "servers": len(fleet.servers),
        "fullest": max(len(server.streams) for server in fleet.servers),
        "shed": 100 * (1 - answered / taken),
    }


class Meter:
    """A TCP relay that counts bytes."""

    def __init__(self, target: str) -> None:
        self._host, _, port = target.rpartition(":")
        self._port = int(port)
        self.up = self.down = 0

    async def connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        there, to_there = await asyncio.open_connection(self._host, self._port)

        async def pump(source: asyncio.StreamReader, sink: asyncio.StreamWriter, way: str) -> None:
            with suppress(OSError):
                while data := await source.read(1 << 16):
                    setattr(self, way, getattr(self, way) + len(data))
                    sink.write(data)
                    await sink.drain()
            sink.close()

        await asyncio.gather(pump(reader, to_there, "up"), pump(there, writer, "down"))


async def bytes_of(server: Server) -> dict[str, float]:
    """Step the bundled sequence, in the formats of a live session with a server elsewhere."""
    source = source_at(bundled_sample())
    frames = [each.frame for each in source][:24]
    meter = Meter(server.address)
    relay = await asyncio.start_server(meter.connected, "127.0.0.1", 0)
    port = relay.sockets[0].getsockname()[1]
    async with (
        relay,
        DepthClient(f"127.0.0.1:{port}") as client,
        client.open_session(
            source.rig,
            delivery=Delivery.NEWEST,
            link="fixed",
            encoding=ImageEncoding.JPEG,
            jpeg_quality=80,
            output=OutputFormat(compressed=True, map_step=2, denominator=16),
        ) as session,
    ):
        for frame in frames:
            left, right = (
                np.asarray(cv2.cvtColor(each, cv2.COLOR_RGB2GRAY), np.uint8)
                for each in (frame.left, frame.right)
            )
            await session.step(left, right, frame.pose)
    return {"up_kb": meter.up / len(frames) / 1e3, "down_kb": meter.down / len(frames) / 1e3}


def headsets(
    hz: float,
    per_server: int,
    wire: dict[str, float],
    snapshots: dict[str, float],
    envoy: dict[str, float],
) -> dict[str, float]:
    """Multiply: what a thousand headsets need of every part."""
    frames = HEADSETS * hz
    return {
        "streams_per_core": per_server / LANES,
        "cores": LANES * np.ceil(HEADSETS / (LOAD * per_server)),
        "up_gbit_s": frames * wire["up_kb"] * 8e-6,
        "down_gbit_s": frames * wire["down_kb"] * 8e-6,
        "redis_saves_s": frames,
        "redis_gbit_s": frames * snapshots["state_mb"] * 8e-3,
        "redis": np.ceil(frames / snapshots["saves_per_core"]),
        "envoy_cores": frames * envoy["cpu_ms"] * 1e-3,
    }


def snapshot_row(file: Path) -> dict[str, float]:
    [row] = [each for each in json.loads(file.read_text())["rows"] if each["size"] == "640x480"]
    del row["size"]
    return dict(row)


async def measure_bytes() -> dict[str, float]:
    async with serving(packaged_weights_dir(), LANES) as server:
        return await bytes_of(server)


def gap_s(real: dict[str, Any]) -> float:
    """Return the longest gap of the streams whose server was killed. Live ones show it best."""
    [kill] = [each for each in real["disturbances"] if each["disturbance"] == "kill -9"]
    gap_ms = kill["live"]["gap_max_ms"] or kill["lossless"]["gap_max_ms"]
    if gap_ms is None:
        raise SystemExit("the server that fleet_real.py killed had no stream; run it again")
    return float(1e-3 * gap_ms)


def simulate(args: argparse.Namespace) -> dict[str, Any]:
    here, cpu_s, rows = asyncio.run(measured(30.0))
    checked = {
        count: {
            **{f"real_{key}": value for key, value in row.items()},
            **steady(SimulatedFleet(here, servers=1, lanes=LANES), [30.0] * int(count)),
        }
        for count, row in rows.items()
    }
    real = json.loads(args.real.read_text())
    costs = replace(
        here,
        beside_s=samples(np.array(here.beside_s), mean_s=cpu_s),
        gap_s=gap_s(real),
        start_s=real["start_s"],
    )
    per_server = {f"{hz:g} Hz": capacity(costs, hz) for hz in RATES_HZ}
    if not all(per_server.values()):
        raise SystemExit(f"a server carries {per_server} streams: is this machine busy?")
    wire, snapshots = asyncio.run(measure_bytes()), snapshot_row(args.snapshots)
    envoy = real["envoy"]["small"]
    return {
        "costs": {
            "alone_ms": 1e3 * float(np.mean(costs.alone_s)),
            "beside_ms": 1e3 * float(np.mean(costs.beside_s)),
            "transport_ms": 1e3 * costs.transport_s,
            "gap_ms": 1e3 * costs.gap_s,
            "start_s": costs.start_s,
        },
        "checked": checked,
        "bytes": wire,
        "capacity": per_server,
        **large(costs, per_server["10 Hz"], args.servers),
        "headsets": {
            f"{hz:g} Hz": headsets(hz, per_server[f"{hz:g} Hz"], wire, snapshots, envoy)
            for hz in RATES_HZ
        },
    }


def large(costs: Costs, per_server: int, servers: int) -> dict[str, Any]:
    """Simulate many servers, with and without a bound on the fullest one."""
    loaded = int(LOAD * per_server)
    figures: dict[str, Any] = {"spread": {}}
    for count, each in ((3, loaded), (10, loaded), (50, loaded), (50, 8 * loaded)):
        draw = partial(fullest, costs, count, each)
        figures["spread"][f"{count} servers of {each}"] = {
            "1024 points": draw(points=1024, balance=np.inf),
            "65536 points": draw(points=65536, balance=np.inf),
            "bound 1.25": draw(points=65536, balance=1.25),
        }
    for name, balance in (("free", np.inf), ("bound 1.25", 1.25)):
        figures[f"kill, {name}"] = killed(costs, servers, loaded * servers, 10.0, balance)
        figures[f"growth, {name}"] = growth(costs, per_server, 10.0, balance)
    return figures


def show(figures: dict[str, Any]) -> None:
    for name, value in figures.items():
        rows = value if isinstance(next(iter(value.values())), dict) else {"": value}
        for row, values in rows.items():
            text = " ".join(f"{key} {number:g}" for key, number in values.items())
            print(f"{f'{name} {row}':30} {text}")  # noqa: T201  a program


def rounded(values: Any) -> Any:
    if isinstance(values, dict):
        return {key: rounded(value) for key, value in values.items()}
    return round(float(values), 3)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--snapshots", type=Path, required=True, help="of snapshot_cost.py")
    parser.add_argument("--real", type=Path, required=True, help="of fleet_real.py")
    parser.add_argument("--servers", type=int, default=20, help="of which one is killed")
    parser.add_argument("--json", type=Path, required=True)
    args = parser.parse_args()
    began_s = time.monotonic()
    figures = rounded(simulate(args))
    show(figures)
    machine = {"instruction_set": instruction_set(), "cores": os.cpu_count()}
    about = {"machine": machine, "seconds": round(time.monotonic() - began_s)}
    args.json.write_text(json.dumps({**about, **figures}, indent=1) + "\n")


if __name__ == "__main__":
    main()
