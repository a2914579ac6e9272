"""Who is next at the model, by what everybody has used; and each turn takes the newest frame."""

import asyncio
from collections import Counter, defaultdict
from collections.abc import Collection, Mapping

import pytest

from tests.support.frames import frame_message, make_frame
from tests.support.models import RecallModel
from tests.support.polling import eventually
from tests.support.server import ManualClock, raw_stream, running_server
from vergence_service.access.principals import Principal
from vergence_service.streams.turns import Turns


class Model:
    """Takes turns one after another, each for the seconds that its stream's steps cost."""

    def __init__(
        self,
        costs_s: Mapping[str, float],
        *,
        lanes: int = 1,
        places: int = 1,
        encoding_s: Mapping[str, float] | None = None,
        content: Collection[str] = (),
    ) -> None:
        self.clock = ManualClock()
        self._encoding_s = encoding_s or {}
        self._content = content  # streams that get all the turns that they want
        self.turns = Turns(places=places, lanes=lanes, clock=self.clock)
        self._costs_s = costs_s
        self.used_s: dict[str, float] = defaultdict(float)
        self.count: Counter[str] = Counter()
        self.most_long = 0
        self._running: dict[str, asyncio.Event] = {}

    async def stream(self, name: str, owner: Principal, until_s: float) -> None:
        while self.clock.now_s < until_s:
            wants_more = name not in self._content
            async with self.turns.turn(
                name, owner, on_soon=lambda: None, wants_more=wants_more
            ) as turn:
                done = self._running[name] = asyncio.Event()
                await done.wait()
                turn.cost.seconds = self._costs_s[name]
                self.used_s[owner.name] += turn.cost.seconds
                self.count[name] += 1
            self.turns.charge(name, self._encoding_s.get(name, 0.0))

    async def run(self, owners: Mapping[str, Principal], seconds: float) -> None:
        """Give every stream turns as fast as it wants them, side by side in the lanes."""
        until_s = self.clock.now_s + seconds
        ends_s: dict[str, float] = {}
        tasks = [
            asyncio.create_task(self.stream(name, owner, until_s)) for name, owner in owners.items()
        ]
        while not all(task.done() for task in tasks):
            for _ in range(12):  # until all have asked for their turns
                await asyncio.sleep(0)
            for name in self._running.keys() - ends_s.keys():
                ends_s[name] = self.clock.now_s + self._costs_s[name]
            long = sum(self._costs_s[name] >= 1.0 for name in self._running)
            self.most_long = max(self.most_long, long)
            if not ends_s:
                continue
            first = min(ends_s, key=lambda name: ends_s[name])
            self.clock.now_s = max(self.clock.now_s, ends_s.pop(first))
            self._running.pop(first).set()


async def test_principals_share_the_model_by_its_seconds_and_their_weights() -> None:
    ana, ben = Principal("ana", weight=1.0), Principal("ben", weight=3.0)
    streams = {"a1": ana, "a2": ana, "a3": ana, "a4": ana, "b": ben}
    costs_s = {"a1": 0.03, "a2": 0.03, "a3": 0.03, "a4": 0.03, "b": 0.04}
    model = Model(costs_s)
    await model.run(streams, 30)
    # 4 ms is a tenth of a percent of the time: one step more or less.
    assert model.used_s["ben"] / model.used_s["ana"] == pytest.approx(3.0, rel=0.03)
    turns = [model.count[name] for name in ("a1", "a2", "a3", "a4")]
    assert max(turns) - min(turns) <= 1


async def test_streams_of_one_principal_share_its_part_by_seconds() -> None:
    one = Principal("local")
    model = Model({"cheap": 0.02, "dear": 0.05})
    await model.run({"cheap": one, "dear": one}, 30)
    assert model.count["cheap"] / model.count["dear"] == pytest.approx(2.5, rel=0.05)


async def test_long_steps_leave_a_lane_to_short_ones() -> None:
    one = Principal("local")
    model = Model({"short": 0.02, "long1": 2.0, "long2": 2.0, "long3": 2.0}, lanes=2, places=3)
    await model.run(dict.fromkeys(("short", "long1", "long2", "long3"), one), 60)
    assert model.count["short"] * 0.02 > 0.8 * 60 / 2  # of half the machine
    model.most_long = 0  # at first, nobody knew
    await model.run(dict.fromkeys(("short", "long1", "long2", "long3"), one), 20)
    assert model.most_long == 1


@pytest.mark.parametrize("owners", [("ana", "ana"), ("ana", "ben")], ids=["one owner", "two"])
@pytest.mark.parametrize("content", [False, True], ids=["could use more", "has enough"])
async def test_long_steps_pay_for_encoding_too_where_others_could_use_more(
    owners: tuple[str, str], content: bool
) -> None:
    large_s, encoding_s = 0.2, 0.3
    model = Model(
        {"small": 0.02, "large": large_s},
        lanes=2,
        places=2,
        encoding_s={"large": encoding_s},
        content=["small"] if content else [],
    )
    await model.run(dict(zip(("small", "large"), map(Principal, owners), strict=True)), 60)
    small_s = 0.02 * model.count["small"]
    paid_s = (large_s + encoding_s) * model.count["large"]
    assert small_s > 58  # it has a lane
    # Both have the same use, or the large one has all that is left.
    assert paid_s == pytest.approx(60 * (1 if not content else 2.5), rel=0.05)


async def test_nobody_saves_turns_for_later() -> None:
    model = Model({"early": 0.1, "late": 0.1})
    ana, ben = Principal("ana"), Principal("ben")
    await model.run({"early": ana}, 100)
    model.used_s.clear()
    await model.run({"early": ana, "late": ben}, 20)
    assert model.used_s["ben"] == pytest.approx(model.used_s["ana"], abs=0.7)


async def test_a_stream_that_leaves_gives_its_turn_to_the_next() -> None:
    turns = Turns(places=1, lanes=1, clock=ManualClock())
    one = Principal("local")
    order: list[str] = []

    async def take(name: str) -> None:
        async with turns.turn(name, one, on_soon=lambda: None):
            order.append(name)
            await asyncio.sleep(0)

    async with turns.turn("first", one, on_soon=lambda: None):
        waiting = [asyncio.create_task(take(name)) for name in ("second", "third")]
        await asyncio.sleep(0)
        waiting[0].cancel()
        await asyncio.sleep(0)
        assert len(turns) == 1
    await asyncio.gather(*waiting, return_exceptions=True)
    assert order == ["third"]
    assert len(turns) == 0


async def test_a_stream_takes_its_newest_frame_when_it_has_a_turn() -> None:
    model = RecallModel()
    async with (
        running_server(model, streams__credit=8) as server,
        raw_stream(server, "one", every=False) as one,
        raw_stream(server, "two", every=False) as two,
        raw_stream(server, "three", every=False) as three,
    ):
        with model.busy():
            # One is in the model. The others wait for their turns.
            await one.send(frame_message(make_frame(1)))
            await asyncio.to_thread(model.wait_until_entered)
            await two.send(frame_message(make_frame(1)))
            await three.send(frame_message(make_frame(1)))
            await eventually(lambda: len(server.engine.turns) == 2)
            for frame_id in range(2, 6):
                await three.send(frame_message(make_frame(frame_id)))
            stream = server.engine.streams.get("three")
            await eventually(lambda: stream.frames_dropped == 4)
        # Every frame is answered once; the order of reports and maps is free.
        stepped: list[int] = []
        dropped: list[int] = []
        while len(stepped) + len(dropped) < 5:
            answer = await three.receive()
            assert answer is not None
            dropped += answer.frames_dropped.frame_ids
            stepped += [answer.disparity.frame_id] if answer.HasField("disparity") else []
        assert (stepped, sorted(dropped)) == ([5], [1, 2, 3, 4])
