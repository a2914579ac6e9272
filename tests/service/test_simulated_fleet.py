"""The simulation of tests/benchmarks/fleet.py obeys what it claims about real servers."""

import math

from tests.support.simulated_fleet import Costs, SimulatedFleet

COSTS = Costs(
    alone_s=(0.02,), beside_s=(0.05,), transport_s=0.005, gap_s=0.4, start_s=1.0
)  # two lanes carry 40 frames a second


def test_a_lone_stream_has_the_whole_server() -> None:
    fleet = SimulatedFleet(COSTS, servers=1, lanes=2)
    stream = fleet.open(10.0)
    fleet.run(10.0)
    assert stream.answered >= stream.taken - 1  # the last one may be in work
    assert {round(age_s, 6) for _, age_s in fleet.ages_s} == {0.025}


def test_under_overload_streams_share_the_lanes_and_answers_stay_young() -> None:
    fleet = SimulatedFleet(COSTS, servers=1, lanes=2)
    streams = [fleet.open(30.0) for _ in range(8)]
    fleet.run(20.0)
    counts = [stream.answered for stream in streams]
    assert 0.95 * 40 * 20 <= sum(counts) <= 40 * 20 + 2
    assert max(counts) - min(counts) <= 2
    # A frame is displaced when the next one arrives, so none waits longer than an interval.
    assert max(age_s for _, age_s in fleet.ages_s) <= 1 / 30 + 0.05 + 0.005 + 1e-9


def test_streams_of_a_killed_server_go_on_after_the_gap_and_others_notice_nothing() -> None:
    fleet = SimulatedFleet(COSTS, servers=4, lanes=2)
    for _ in range(8):
        fleet.open(4.0)
    fleet.run(5.0)
    victim = max(fleet.servers, key=lambda server: len(server.streams))
    moved = set(victim.streams)
    fleet.kill(victim)
    fleet.run(10.0)
    assert moved
    assert all(stream.server in fleet.alive for stream in fleet.streams)
    assert min(stream.longest_gap_s for stream in moved) >= 0.4
    assert max(s.longest_gap_s for s in fleet.streams if s not in moved) < 0.4


def test_a_bound_keeps_the_fullest_server_near_the_mean() -> None:
    fullest = {}
    for balance in (math.inf, 1.25):
        fleet = SimulatedFleet(COSTS, servers=20, lanes=2, balance=balance)
        for _ in range(80):
            fleet.open(1.0)
        assert sum(len(server.streams) for server in fleet.servers) == 80
        fullest[balance] = max(len(server.streams) for server in fleet.servers)
    assert fullest[1.25] <= 5 < fullest[math.inf]
