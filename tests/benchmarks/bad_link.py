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
- ``depth_at_ms``: the time of one ``depth_at`` at 640x480.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
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
    stalls_from_s: float = 0.0


def python(prefix: Sequence[str], *arguments: str) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [*prefix, sys.executable, *arguments],
        cwd=REPOSITORY,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        text=True,
    )


@contextmanager
def serving(place: Place, maps: Path) -> Iterator[str]:
    """A server with recorded maps; yields its gRPC address."""
    with python(
        place.server, "-m", "tests.support.recorded_model", str(maps), place.host
    ) as process:
        assert process.stdout is not None
        try:
            yield process.stdout.readline().split()[0]
        finally:
            process.terminate()


def play(place: Place, plan: Plan) -> dict[str, Any]:
    with python(place.client, "-m", "tests.support.headset", json.dumps(asdict(plan))) as process:
        output, _ = process.communicate()
    figures: dict[str, Any] = json.loads(output)
    return figures


def measure(place: Place, shape: LinkShape, maps: Path, seconds: float) -> dict[str, Any]:
    with serving(place, maps) as address:
        if place.client:
            return clients(place, f"grpc://{address}", shape, maps, seconds)
        with shaped_proxy(address, shape) as (proxy, started_s):
            place = replace(place, stalls_from_s=started_s)
            return clients(place, f"grpc://{proxy}", shape, maps, seconds)


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
                    place = Place(link.client, link.server, SERVER_IP, link.started_s)
                    figures[name] = measure(place, shape, maps, args.seconds)
            else:
                figures[name] = measure(Place((), (), "127.0.0.1"), shape, maps, args.seconds)
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
    args = parser.parse_args()
    args.json.write_text(json.dumps(run(args), indent=2))


if __name__ == "__main__":
    main()
