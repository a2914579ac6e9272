"""Measure live depth over bad links: rates, ages, and errors of what a display would show.

    python tests/benchmarks/bad_link.py --json FILE

A headset plays the bundled sequence, with its poses, through the SDK to a real server. The server's
model is replaced by recorded maps that take 15 ms each, so that the way is measured. The link is
made of two network namespaces and a TUN device with the kernel's own TCP at both ends, which needs
root; else it is a proxy that shapes the bytes (``"link": "proxy"``). Per link:

- ``results_hz age_p50_ms age_p95_ms``: the SDK with ``link="auto"``, at the ticks of a 72 Hz
  display; ``stalls``: without the ticks inside a stall.
- ``naive_age_p95_ms``: one pair at a time, JPEG 90, request and reply.
- ``today_results_hz today_age_p95_ms``: the defaults of version 0.1, raw colour and full maps.
- ``epe_ratio_covered epe_ratio_all covered``: the end-point error of ``depth_at`` at the pose of
  the moment over that of a map of the moment, where a result saw the surface and everywhere.
- ``depth_at_ms``: the processor's time of one ``depth_at`` at 640x480, all threads together.

``--opens`` opens sessions over gRPC, HTTP and Zenoh (over TCP, without shared memory) instead:
``opened`` of ``tried`` at round trips of 60, 150 and 300 ms, and at 8 Mbit/s.

``--ends`` ends 500 sessions over each transport while a frame is on its way, and counts the
``errors`` that reach the program.

``--outages`` cuts the link for 3, 12, 20 and 60 s, kills the server, and changes the address of the
client, in the middle of sessions over all three:

- ``errors``: exceptions that reached the program.
- ``reported_s``: from the cut until ``session.state`` showed it.
- ``warm_again_s``: from the return of the link, or of the server, to the first warm result.
- ``state_kept``: the memory lived on; ``same_bits``: the next result is what it would have been.
- ``left``: tasks, threads and descriptors that are there after the sessions, and were not before.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).parents[2]
sys.path.insert(0, str(REPOSITORY))  # tests.support

from tests.support.headset import Plan  # noqa: E402
from tests.support.recorded_model import record  # noqa: E402
from tests.support.shaped_proxy import shaped_proxy  # noqa: E402
from tests.support.tun_link import (  # noqa: E402
    SERVER_IP,
    LinkShape,
    can_make_links,
    tun_link,
)
from vergence_proto.datasets import open_source  # noqa: E402
from vergence_proto.instruction_set import instruction_set  # noqa: E402

SEQUENCE = REPOSITORY / "client/vergence/sample/room"
GRPC_PORT, HTTP_PORT, ZENOH_PORT = 50051, 8000, 7447
OPENINGS = {
    "60 ms": LinkShape(delay_ms=30),
    "150 ms": LinkShape(delay_ms=75),
    "300 ms": LinkShape(delay_ms=150),
    "8 Mbit/s": LinkShape(8, 30),
}
ADDRESSES = [
    f"{scheme}://{SERVER_IP}:{port}"
    for scheme, port in (("grpc", GRPC_PORT), ("http", HTTP_PORT), ("zenoh", ZENOH_PORT))
]
OUTAGES = ("3", "12", "20", "60", "killed", "moved")
OUTAGE_LINK = LinkShape(50, 5, 2)
LINKS = {
    "50": LinkShape(50, 5, 2),
    "20": LinkShape(20, 10, 5),
    "8": LinkShape(8, 30, 0),
    "stalls": LinkShape(50, 5, 2, stall_every_s=5, stall_ms=300),
}


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Where client and server run: command prefixes, and the server's host for each."""

    client: Sequence[str]
    server: Sequence[str]
    host: str
    transport: str = "grpc"
    stalls_from_s: float = 0.0


def python(prefix: Sequence[str], *arguments: str) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [*prefix, sys.executable, *arguments],
        cwd=REPOSITORY,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


@contextmanager
def serving(place: Place, maps: Path) -> Iterator[str]:
    """A server with recorded maps; yields its address over the transport."""
    with python(
        place.server, "-m", "tests.support.recorded_model", str(maps), place.host
    ) as process:
        assert process.stdout is not None
        try:
            yield process.stdout.readline().split()[place.transport == "http"]
        finally:
            process.terminate()


def server_of_all(place: Place, maps: str) -> "subprocess.Popen[str]":
    """Start a server on fixed ports, over all transports; return when it serves."""
    process = python(
        place.server,
        *("-m", "tests.support.recorded_model", maps, place.host),
        *(f"grpc.port={GRPC_PORT}", f"http.port={HTTP_PORT}", "zenoh.enabled=true"),
    )
    assert process.stdout is not None
    assert process.stdout.readline()
    return process


def repeated(module: str, shapes: dict[str, LinkShape], count: int) -> dict[str, Any]:
    """Run a module with each address of a server behind each link."""
    figures: dict[str, Any] = {}
    for name, shape in shapes.items():
        figures[name] = {}
        with tun_link(shape) as link:
            place = Place(link.client, link.server, SERVER_IP)
            with server_of_all(place, "recall") as server:
                for address in ADDRESSES:
                    plan = json.dumps({"server": address, "count": count})
                    with python(place.client, "-m", module, plan) as process:
                        output, _ = process.communicate()
                    row = json.loads(output)
                    figures[name][address.partition(":")[0]] = row
                    show(f"{name} {address}", row)
                server.terminate()
    return figures


def outages(names: Sequence[str]) -> dict[str, Any]:
    return {name: outage(name) for name in names}


def outage(name: str) -> dict[str, Any]:
    """Film through one outage: of so many seconds, "killed" or "moved"."""
    with tun_link(OUTAGE_LINK) as link:
        place = Place(link.client, link.server, SERVER_IP)
        server = server_of_all(place, "recall")
        plan = json.dumps({"servers": ADDRESSES})
        with python(place.client, "-m", "tests.support.link_outages", plan) as process:
            assert process.stdin is not None
            assert process.stdout is not None
            assert process.stdout.readline() == "live\n"
            cut_s = return_s = time.monotonic()
            if name == "moved":
                link.move_client()
            elif name == "killed":
                server.kill()
                server.wait()
                server = server_of_all(place, "recall")
                return_s = time.monotonic()
            else:
                link.cut(float(name))
                return_s = cut_s + float(name)
            process.stdin.write(f"{cut_s} {return_s}\n")
            output, _ = process.communicate()
        server.terminate()
        server.wait()
    rows: dict[str, Any] = json.loads(output)
    for transport, row in rows.items():
        show(f"{name} {transport}", row)
    return rows


def play(place: Place, plan: Plan) -> dict[str, Any]:
    with python(place.client, "-m", "tests.support.headset", json.dumps(asdict(plan))) as process:
        output, _ = process.communicate()
    figures: dict[str, Any] = json.loads(output)
    return figures


def measure(place: Place, shape: LinkShape, maps: Path, seconds: float) -> dict[str, Any]:
    with serving(place, maps) as address:
        if place.client:
            return clients(place, f"{place.transport}://{address}", shape, maps, seconds)
        with shaped_proxy(address, shape) as (proxy, started_s):
            place = replace(place, stalls_from_s=started_s)
            return clients(place, f"{place.transport}://{proxy}", shape, maps, seconds)


def clients(
    place: Place, server: str, shape: LinkShape, maps: Path, seconds: float
) -> dict[str, Any]:
    plan = Plan(
        server,
        str(SEQUENCE),
        "sdk",
        seconds,
        record=str(maps),
        stall_every_s=shape.stall_every_s,
        stall_ms=shape.stall_ms,
        stalls_from_s=place.stalls_from_s,
    )
    row = play(place, plan)
    naive, today = (play(place, replace(plan, kind=kind)) for kind in ("naive", "today"))
    return row | {
        "naive_age_p95_ms": naive["age_p95_ms"],
        "today_results_hz": today["results_hz"],
        "today_age_p95_ms": today["age_p95_ms"],
    }


def run(args: argparse.Namespace) -> dict[str, Any]:
    source = open_source(f"vergence:{SEQUENCE}")
    figures: dict[str, Any] = {"instruction_set": instruction_set(), "link": args.link}
    with tempfile.TemporaryDirectory() as folder:
        maps = Path(folder, "maps.npz")
        record([each.frame for each in source], source.rig, maps)
        for name in args.links:
            shape = LINKS[name]
            if args.link == "tun":
                with tun_link(shape) as link:
                    place = Place(
                        link.client, link.server, SERVER_IP, args.transport, link.started_s
                    )
                    figures[name] = measure(place, shape, maps, args.seconds)
            else:
                place = Place((), (), "127.0.0.1", args.transport)
                figures[name] = measure(place, shape, maps, args.seconds)
            show(name, figures[name])
    return figures


def show(name: str, row: dict[str, Any]) -> None:
    shown = {key: value for key, value in row.items() if key != "links"}
    print(name, json.dumps(shown), flush=True)  # noqa: T201


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--links", nargs="+", choices=LINKS, default=list(LINKS))
    parser.add_argument(
        "--link", choices=("tun", "proxy"), default="tun" if can_make_links() else "proxy"
    )
    parser.add_argument("--transport", choices=("grpc", "http"), default="grpc")
    parser.add_argument("--opens", type=int, nargs="?", const=20, metavar="COUNT")
    parser.add_argument("--ends", type=int, nargs="?", const=500, metavar="COUNT")
    parser.add_argument("--outages", nargs="*", choices=OUTAGES)
    args = parser.parse_args()
    if args.opens:
        figures = repeated("tests.support.link_openings", OPENINGS, args.opens)
    elif args.ends:
        shapes = {"20 Mbit/s": LINKS["20"]}
        figures = repeated("tests.support.link_endings", shapes, args.ends)
    elif args.outages is not None:
        figures = outages(args.outages or OUTAGES)
    else:
        figures = run(args)
    args.json.write_text(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
