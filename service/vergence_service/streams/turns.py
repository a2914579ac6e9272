"""The turns of live streams at the model: who is next, by what everybody has used.

A stream waits for its turn, and takes its newest frame only when it has one. So an answer is as
old as one step and one frame of the camera, however many streams wait.
"""

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from functools import partial

from vergence_service.access.principals import Principal
from vergence_service.process.threads import Cost

# Steps that are so many times longer than those of others, and longer than this, leave a lane to
# the others: they could have no turn meanwhile.
_LONG_TIMES = 3.0
_LONG_S = 0.05
# A stream without a turn for so long is not in the way of others, and its use is forgotten.
_ACTIVE_S = 2.0
# A stream hears of its turn so long before, to send a newer frame.
_NOTICE_S = 0.06
_SMOOTHING = 0.2
# Who uses less than its share may be so far behind the others, and gets its turns at once.
_MOST_BEHIND_S = 0.5
# Who takes long steps may be so far ahead of a stream that could use more. That stream may be
# without a turn for so long, while its answer is encoded.
_MOST_AHEAD_S = 0.02
_RETURN_S = 0.05
_FOREVER_S = 1e9
_TICKS = 4  # of the event loop, until a stream that had a turn has asked for the next


@dataclass(slots=True, eq=False)
class _Account:
    """What a principal, or one of its streams, has used: seconds of work over its weight."""

    used_s: float
    seen_s: float  # time of the last turn, or wait for one


@dataclass(slots=True, eq=False)
class _StreamAccount(_Account):
    cost_s: float = 0.0  # of a turn, lately
    owed_s: float = 0.0  # work beside its turns, to be charged with the next one
    last: "Turn | None" = None


@dataclass(slots=True, eq=False)
class Turn:
    """A turn of one stream. The time that its work takes is to be added to ``cost``.

    ``wants_more`` if its frame was there before the stream could take it: more turns would give
    the stream more answers.
    """

    stream: str
    owner: Principal
    on_soon: Callable[[], None]
    granted: "asyncio.Future[None]"
    since_s: float
    expected_s: float = 0.0
    cost: Cost = field(default_factory=Cost)
    wants_more: bool = True
    noticed: bool = False
    ended_s: float | None = None


class Turns:
    """Grants turns, as many at once as ``places``.

    The next turn goes to the principal that has used the least time for its weight, and there to
    the stream that has used the least. Time is that of decoding, of the model and of encoding. Who
    did not want a turn for a while does not save up for later.

    A place is no right to a long step: the threads of all places share the processor. A stream with
    long steps waits while one that has used less has its turn, or just had it, and could use more.
    """

    def __init__(self, *, places: int, lanes: int, clock: Callable[[], float]) -> None:
        self._places = places
        self._long_places = max(lanes - 1, 1)
        self._clock = clock
        self._waiting: list[Turn] = []
        self._running: list[Turn] = []
        self._principals: dict[str, _Account] = {}
        self._streams: dict[str, _StreamAccount] = {}
        self._interval_s = 0.0  # between two turns, lately
        self._last_end_s = clock()

    def __len__(self) -> int:
        return len(self._waiting)

    def forget(self, stream: str) -> None:
        """Forget a stream, because it is closed."""
        self._streams.pop(stream, None)

    @asynccontextmanager
    async def turn(
        self,
        stream: str,
        owner: Principal,
        *,
        on_soon: Callable[[], None],
        wants_more: bool = True,
    ) -> AsyncIterator[Turn]:
        """Wait for a turn of a stream; it lasts as long as the block.

        ``on_soon`` is called shortly before the turn, or at once if it is near.
        """
        now_s = self._clock()
        granted: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        turn = Turn(stream, owner, on_soon, granted, now_s, wants_more=wants_more)
        self._enter(turn, now_s)
        self._waiting.append(turn)
        self._grant()
        try:
            await granted
            yield turn
        finally:
            if turn in self._waiting:
                self._waiting.remove(turn)
            else:
                self._end(turn)
            self._grant_soon()

    def charge(self, stream: str, seconds: float) -> None:
        """Charge work that was done for a stream beside its turns.

        Its next turn is charged for it. Before, it would lose its place among those that wait, and
        its frame would be old when it has its turn.
        """
        if (account := self._streams.get(stream)) is not None:
            account.owed_s += seconds

    def _enter(self, turn: Turn, now_s: float) -> None:
        """Open the accounts of a turn, or bring them up to date."""
        name = turn.owner.name
        here = [*self._waiting, *self._running]
        others = {each.owner.name for each in here} - {name}
        account = self._principals.setdefault(name, _Account(0.0, -_FOREVER_S))
        _catch_up(account, [self._principals[each].used_s for each in others], now_s)
        mine = {each.stream for each in here if each.owner.name == name} - {turn.stream}
        known = [self._streams[each].used_s for each in mine if each in self._streams]
        own = self._streams.setdefault(turn.stream, _StreamAccount(0.0, -_FOREVER_S))
        _catch_up(own, known, now_s)
        turn.expected_s = own.cost_s

    def _grant_soon(self, after: int = _TICKS) -> None:
        """Grant the turns that are free when all that is ready now has been done.

        A stream whose turn ends, and that has another frame, is then among those that wait.
        """
        asyncio.get_running_loop().call_soon(
            self._grant if after == 1 else partial(self._grant_soon, after - 1)
        )

    def _grant(self) -> None:
        while len(self._running) < self._places and (turn := self._next()) is not None:
            self._waiting.remove(turn)
            self._running.append(turn)
            if (account := self._streams.get(turn.stream)) is not None:
                account.last = turn
                self._charge(turn.stream, turn.owner, account.owed_s)
                account.owed_s = 0.0
            # As if it had ended already: the next choice must know of it.
            self._charge(turn.stream, turn.owner, turn.expected_s)
            self._notice(turn)
            if not turn.granted.done():
                turn.granted.set_result(None)
        self._notice_those_near()
        if self._waiting and not self._running:
            # Held back for a stream that may return; nobody else would ask.
            asyncio.get_running_loop().call_later(_RETURN_S, self._grant)

    def _order(self, turn: Turn) -> tuple[float, float, float]:
        principal = self._principals[turn.owner.name].used_s
        stream = self._streams.get(turn.stream)
        return principal, stream.used_s if stream else 0.0, turn.since_s

    def _next(self) -> Turn | None:
        long_s = self._long_s()
        long = sum(each.expected_s > long_s for each in self._running)
        allowed = [
            each
            for each in self._waiting
            if each.expected_s <= long_s
            or (long < self._long_places and not self._in_the_way(each))
        ]
        return min(allowed, key=self._order, default=None)

    def _in_the_way(self, turn: Turn) -> bool:
        """Decide whether a stream has used more than one that could use more just now."""
        now_s = self._clock()
        for other in [each.last for each in self._streams.values()]:
            if (
                other is not None
                and other.wants_more
                and (other.ended_s is None or now_s - other.ended_s <= _RETURN_S)
                and self._ahead_s(turn, other) > _MOST_AHEAD_S
            ):
                return True
        return False

    def _ahead_s(self, turn: Turn, other: Turn) -> float:
        accounts: Mapping[str, _Account] = self._streams
        mine, others = turn.stream, other.stream
        if turn.owner.name != other.owner.name:
            accounts, mine, others = self._principals, turn.owner.name, other.owner.name
        if mine not in accounts or others not in accounts:  # closed, or not seen for long
            return 0.0
        return accounts[mine].used_s - accounts[others].used_s

    def _long_s(self) -> float:
        """Return the time above which a step is long beside those of the streams of late."""
        now_s = self._clock()
        here = {each.stream for each in (*self._waiting, *self._running)}
        costs = [
            each.cost_s
            for name, each in self._streams.items()
            if each.cost_s and (name in here or now_s - each.seen_s <= _ACTIVE_S)
        ]
        return max(_LONG_TIMES * min(costs, default=0.0), _LONG_S)

    def _notice_those_near(self) -> None:
        if not self._waiting:
            return
        turns_ahead = 1 + int(_NOTICE_S / self._interval_s) if self._interval_s else None
        if turns_ahead is None or turns_ahead >= len(self._waiting):
            near = self._waiting
        else:
            near = sorted(self._waiting, key=self._order)[:turns_ahead]
        for turn in near:
            self._notice(turn)

    def _notice(self, turn: Turn) -> None:
        if not turn.noticed:
            turn.noticed = True
            turn.on_soon()

    def _end(self, turn: Turn) -> None:
        self._running.remove(turn)
        turn.ended_s = now_s = self._clock()
        self._charge(turn.stream, turn.owner, turn.cost.seconds - turn.expected_s)
        self._principals[turn.owner.name].seen_s = now_s
        if turn.cost.seconds and (stream := self._streams.get(turn.stream)) is not None:
            stream.seen_s = now_s
            known_s = stream.cost_s or turn.cost.seconds
            stream.cost_s = known_s + _SMOOTHING * (turn.cost.seconds - known_s)
        between_s = now_s - self._last_end_s
        self._last_end_s = now_s
        if self._waiting:  # else the pause says nothing about the model
            known_s = self._interval_s or between_s
            self._interval_s = known_s + _SMOOTHING * (between_s - known_s)
        self._forget_old(now_s)

    def _charge(self, stream: str, owner: Principal, seconds: float) -> None:
        self._principals[owner.name].used_s += seconds / owner.weight
        if (account := self._streams.get(stream)) is not None:
            account.used_s += seconds

    def _forget_old(self, now_s: float) -> None:
        here = {each.owner.name for each in (*self._waiting, *self._running)}
        for name, account in list(self._principals.items()):
            if name not in here and now_s - account.seen_s > 60 * _ACTIVE_S:
                del self._principals[name]


def _catch_up(account: _Account, others_s: Sequence[float], now_s: float) -> None:
    """Bring an account that lags behind the others near them: nobody saves up for later."""
    if others_s:
        away = now_s - account.seen_s > _ACTIVE_S
        least_s = min(others_s) if away else max(others_s) - _MOST_BEHIND_S
        account.used_s = max(account.used_s, least_s)
    account.seen_s = now_s
