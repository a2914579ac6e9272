"""Laws of the link's measurement and of the controller, in a simulated link without a clock."""

import heapq
import random
from collections import Counter
from dataclasses import dataclass
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vergence.image_format import ImageFormat
from vergence.link import LinkRules, LinkState, SessionLink
from vergence.link_control import DOWNLOADS, UPLOADS, LinkController
from vergence.link_meter import LinkTimes
from vergence_proto.types import ImageEncoding
from vergence_proto.v1 import depth_pb2 as pb

CAMERA_S = 1 / 30
SERVER_S = 0.02
RATES_MBIT = st.floats(1.5, 300)
CREDIT = 12


@dataclass
class Way:
    """One direction: bytes go one after the other, then fly. Times in seconds."""

    bytes_s: float
    delay_s: float
    jitter_s: float
    chance: random.Random
    free_s: float = 0.0
    last_s: float = 0.0

    def arrival_s(self, now_s: float, nbytes: float) -> float:
        self.free_s = max(now_s, self.free_s) + nbytes / self.bytes_s
        flight_s = self.delay_s + self.jitter_s * self.chance.random()
        self.last_s = max(self.free_s + flight_s, self.last_s)
        return self.last_s


class Simulation:
    """The real link of a session, between a camera and a server over two simulated ways."""

    def __init__(
        self,
        mbit: float,
        delay_s: float = 0.01,
        *,
        jitter_s: float = 0.0,
        offset_s: float = 1000.0,
        seed: int = 0,
    ) -> None:
        chance = random.Random(seed)
        self.up, self.down = (Way(mbit * 125_000, delay_s, jitter_s, chance) for _ in range(2))
        self._offset_s = offset_s  # of the server's clock
        self._now_s = 1.0
        rules = LinkRules(ImageFormat(ImageEncoding.JPEG, 80, grey=True), map_step=2, adapts=True)
        self.link = SessionLink(rules, clock_ns=lambda: _ns(self._now_s))
        self.link.attached(pb.StreamOpened(max_frame_scale=2))
        self._server_free_s = 0.0
        self._frame_id = 0
        self._unanswered = self._count = 0
        self._arrivals: list[tuple[float, int, pb.StreamDepthResponse]] = []
        self.rungs: list[tuple[int, int]] = []
        self.queues_s: list[float] = []
        self._ping()

    @property
    def rung(self) -> tuple[int, int]:
        """The rungs of the moment: 0 is the best."""
        state = self.link.state
        ups = [(each.jpeg_quality, each.scale) for each in UPLOADS]
        downs = [each.map_step for each in DOWNLOADS]
        return ups.index((state.jpeg_quality, state.scale)), downs.index(state.map_step)

    def change(self, mbit: float) -> None:
        self.up.bytes_s = self.down.bytes_s = mbit * 125_000

    def run(self, seconds: float) -> LinkState:
        """Film for so long; what was noted before is forgotten."""
        self.rungs, self.queues_s = [], []
        ends_s = self._now_s + seconds
        while self._now_s < ends_s:
            frame_s = self._now_s + CAMERA_S
            while self._arrivals and self._arrivals[0][0] <= frame_s:
                self._now_s, _, response = heapq.heappop(self._arrivals)
                self._unanswered -= response.HasField("disparity")
                self.link.heard(response)
            self._now_s = frame_s
            if self._unanswered < CREDIT and self.link.refusal(self._unanswered) is None:
                self._send()
            self.rungs.append(self.rung)
        return self.link.state

    def _send(self) -> None:
        self._frame_id += 1
        self._unanswered += 1
        ping_ns = self._ping() if self._frame_id % 8 == 1 else None
        up, down = self.rung
        nbytes = int(UPLOADS[up].relative_bytes * 1000)
        self.link.frame_sent(self._frame_id, nbytes, ping_ns=ping_ns)
        self.queues_s.append(max(self.up.free_s - self._now_s, 0.0))
        received_s = self.up.arrival_s(self._now_s, nbytes)
        self._server_free_s = max(received_s, self._server_free_s) + SERVER_S
        message = pb.DisparityMap(
            frame_id=self._frame_id, received_ns=_ns(received_s + self._offset_s)
        )
        message.timings.total_us = int((self._server_free_s - received_s) * 1e6)
        message.timings.model_us = int(SERVER_S * 1e6)
        message.disparity.data = bytes(int(DOWNLOADS[down].relative_bytes * 1000))
        arrived_s = self.down.arrival_s(self._server_free_s, len(message.disparity.data))
        self._arrive(arrived_s, pb.StreamDepthResponse(disparity=message))

    def _ping(self) -> int:
        received_s = self.up.arrival_s(self._now_s, 40)
        pong = pb.Pong(client_ns=_ns(self._now_s), received_ns=_ns(received_s + self._offset_s))
        self._arrive(received_s + self.down.delay_s, pb.StreamDepthResponse(pong=pong))
        return pong.client_ns

    def _arrive(self, at_s: float, response: pb.StreamDepthResponse) -> None:
        self._count += 1
        heapq.heappush(self._arrivals, (at_s, self._count, response))


def _ns(seconds: float) -> int:
    return int(seconds * 1e9)


@settings(max_examples=10, deadline=None)
@given(mbit=RATES_MBIT, delay_s=st.floats(0, 0.15), offset_s=st.floats(0, 1e6))
def test_the_rates_and_the_path_are_measured_without_a_common_clock(
    mbit: float, delay_s: float, offset_s: float
) -> None:
    state = Simulation(mbit, delay_s, offset_s=offset_s).run(5)
    assert state.up_mbit_s == pytest.approx(mbit, rel=0.05)
    assert state.down_mbit_s == pytest.approx(mbit, rel=0.05)
    assert state.path_round_trip_s == pytest.approx(2 * delay_s, abs=0.001)


@settings(max_examples=10, deadline=None)
@given(mbit=RATES_MBIT, jitter_s=st.sampled_from([0.0, 0.004, 0.01]), seed=st.integers(0, 9))
def test_a_steady_link_gets_a_steady_rung(mbit: float, jitter_s: float, seed: int) -> None:
    simulation = Simulation(mbit, jitter_s=jitter_s, seed=seed)
    simulation.run(10)
    simulation.run(10)
    left = Counter(up for (up, _), (after, _) in pairwise(simulation.rungs) if after > up)
    # Jitter of a third of the time between frames may look like a queue, once: no rung is left
    # twice, so the format does not go to and fro.
    assert max(left.values(), default=0) <= (1 if jitter_s else 0)


@settings(max_examples=10, deadline=None)
@given(mbit=RATES_MBIT, seed=st.integers(0, 9))
def test_frames_do_not_queue_on_a_paced_link(mbit: float, seed: int) -> None:
    simulation = Simulation(mbit, jitter_s=0.004, seed=seed)
    simulation.run(3)
    simulation.run(10)
    # At most one frame is on the wire when the next one leaves, and only for a part of its time.
    slowest_s = UPLOADS[-1].relative_bytes * 1000 / simulation.up.bytes_s
    assert max(simulation.queues_s) <= max(0.03, 1.2 * slowest_s)


@settings(max_examples=8, deadline=None)
@given(before=st.floats(4, 100), after=st.floats(4, 100))
def test_a_link_that_changes_is_followed(before: float, after: float) -> None:
    changing, steady = Simulation(before), Simulation(after)
    changing.run(5)
    changing.change(after)
    changing.run(20)
    steady.run(20)
    # Between two rungs the history decides, but not by more than one.
    for now, then in zip(changing.rung, steady.rung, strict=True):
        assert abs(now - then) <= 1


LINK_TIMES = st.builds(
    LinkTimes,
    frames=st.just(12),
    up_bytes_s=st.floats(1e4, 1e9),
    down_bytes_s=st.floats(1e4, 1e9),
    up_queue_s=st.floats(0, 10),
    up_queue_growth=st.floats(-5, 5),
    server_s=st.floats(0, 10),
    frame_bytes=st.floats(100, 1e7),
    map_bytes=st.floats(100, 1e7),
    answer_s=st.floats(0.001, 10),
)


@settings(max_examples=40, deadline=None)
@given(steps=st.lists(st.tuples(LINK_TIMES, st.floats(0, 1), st.floats(0, 2)), max_size=30))
def test_whatever_is_measured_the_choice_is_bounded(
    steps: list[tuple[LinkTimes, float, float]],
) -> None:
    controller, now_s = LinkController(), 0.0
    for times, returned_share, elapsed_s in steps:
        now_s += elapsed_s
        choice = controller.update(
            times, camera_s=CAMERA_S, returned_share=returned_share, now_s=now_s
        )
        assert 0.5 <= controller.headroom <= 1
        assert choice.upload in UPLOADS
        assert choice.download in DOWNLOADS
        assert 0 < choice.interval_s < float("inf")
        assert (choice.limited_by == "camera") == (choice.interval_s <= CAMERA_S)


@settings(max_examples=40, deadline=None)
@given(slow=st.floats(1e4, 1e8), faster=st.floats(1, 100))
def test_a_faster_link_never_gets_a_worse_rung(slow: float, faster: float) -> None:
    rungs = []
    for rate in (slow, slow * faster):
        times = LinkTimes(
            frames=12,
            up_bytes_s=rate,
            down_bytes_s=rate,
            server_s=SERVER_S,
            frame_bytes=64_700,
            map_bytes=28_000,
            answer_s=0.1,
        )
        choice = LinkController(first=UPLOADS[1]).update(
            times, camera_s=CAMERA_S, returned_share=1.0, now_s=0.0
        )
        # The measurement is that of the rung in use, whose bytes are known.
        rungs.append((UPLOADS.index(choice.upload), DOWNLOADS.index(choice.download)))
    assert rungs[1][0] <= rungs[0][0]
    assert rungs[1][1] <= rungs[0][1]


def test_a_queue_that_grows_lowers_the_rate_and_a_calm_link_raises_it_again() -> None:
    controller = LinkController()
    calm = LinkTimes(
        frames=12, up_bytes_s=1e7, down_bytes_s=1e7, frame_bytes=93_000, map_bytes=28_000
    )
    grows = LinkTimes(
        frames=12,
        up_bytes_s=1e7,
        down_bytes_s=1e7,
        frame_bytes=93_000,
        map_bytes=28_000,
        up_queue_s=0.05,
        up_queue_growth=0.2,
    )
    for step in range(30):
        controller.update(grows, camera_s=CAMERA_S, returned_share=1.0, now_s=step * 0.1)
    assert controller.headroom == 0.5
    for step in range(30, 150):
        controller.update(calm, camera_s=CAMERA_S, returned_share=1.0, now_s=step * 0.1)
    assert controller.headroom == 1.0
