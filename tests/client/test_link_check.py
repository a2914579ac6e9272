"""What `vergence doctor --server` measures, and what it advises."""

import io
from dataclasses import replace

import pytest
from rich.console import Console

from vergence.cli.doctor import examine_link
from vergence.cli.link_check import CAMERA_HZ, LinkFigures, link_advice
from vergence.link import LinkState
from vergence.link_control import LimitedBy
from vergence_service.app.server import Running

LINK = LinkState(
    adapts=True,
    jpeg_quality=80,
    scale=1,
    map_step=2,
    interval_s=1 / CAMERA_HZ,
    limited_by="camera",
    up_mbit_s=8.0,
    down_mbit_s=4.0,
    path_round_trip_s=0.01,
    up_queue_s=0.0,
    down_queue_s=0.0,
    server_s=0.08,
)
GOOD = LinkFigures(
    open_s=0.1,
    round_trip_s=0.01,
    results_hz=CAMERA_HZ,
    ages_s=[0.05] * 100,
    longest_silence_s=0.05,
    sent=100,
    link=LINK,
)


def advised(figures: LinkFigures) -> str:
    return "\n".join(link_advice(figures))


def test_a_good_link_gets_its_rate_and_no_advice() -> None:
    assert advised(GOOD) == "expect 30 maps a second, 50 ms old when they arrive"


@pytest.mark.parametrize(
    ("limit", "says"),
    [
        ("uplink", "the uplink is the limit, 8 Mbit/s: smaller images"),
        ("downlink", "the downlink is the limit, 4 Mbit/s"),
        ("server", "the server is the limit, 80 ms a frame"),
        ("camera", "this machine is busy"),
    ],
)
def test_the_part_that_limits_the_rate_is_named(limit: LimitedBy, says: str) -> None:
    assert says in advised(replace(GOOD, results_hz=12.0, link=replace(LINK, limited_by=limit)))


def test_old_maps_silence_and_a_long_way_are_named() -> None:
    assert "depth_at()" in advised(replace(GOOD, ages_s=[0.05] * 90 + [0.2] * 10))
    assert "silent for 0.7 s" in advised(replace(GOOD, longest_silence_s=0.7))
    assert "takes 150 ms" in advised(replace(GOOD, round_trip_s=0.15))
    assert "no result came back" in advised(replace(GOOD, ages_s=[], results_hz=0.0))


async def test_a_test_stream_measures_a_real_server(server: Running) -> None:
    text = io.StringIO()
    await examine_link(server.grpc_address, 1.0, Console(file=text, width=200))
    lines = {line[:17].strip(): line[17:].strip() for line in text.getvalue().splitlines()}
    assert float(lines["session opens in"].split()[0]) > 0
    assert float(lines["results"].split()[0]) > 1
    assert "expect" in text.getvalue()
