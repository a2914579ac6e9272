"""The stream table under any sequence of events, against a model of a few lines."""

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, invariant, rule
from prometheus_client import CollectorRegistry

from tests.support.frames import REACH, RIG
from tests.support.server import ManualClock
from vergence_proto.errors import (
    DepthError,
    Quota,
    StateMemory,
    StreamExists,
    StreamExpired,
    StreamLimit,
    Superseded,
    UnknownStream,
)
from vergence_proto.types import StereoRig
from vergence_service.process.memory import MemoryBudget, MemoryKind, StreamMemory
from vergence_service.process.metrics import Metrics
from vergence_service.streams.quotas import Quotas
from vergence_service.streams.rectify import Rectifier
from vergence_service.streams.stream import Notice, Stream, StreamConfig
from vergence_service.streams.table import StreamTable

CAPACITY, PER_CLIENT, MEMORY, STATE = 3, 2, 1000, 400
IDLE_S, NOTICE_S, GRACE_S, TOMBSTONE_S, SILENT_S = 60.0, 10.0, 10.0, 300.0, 15.0
RIG_OPENING = StreamConfig(StereoRig.from_rectified(RIG))
RECTIFIER = Rectifier.of(RIG_OPENING.rig, REACH)


class Connection:
    """An attachment that records its notices and its end."""

    transport = "grpc"
    trace_parent = None

    def __init__(self, clock: ManualClock) -> None:
        self.notices: list[Notice] = []
        self.errors: list[DepthError] = []
        self.losses: list[str] = []
        self.busy = False
        self.heard_s = clock.now_s
        self.stream: Stream | None = None
        self._clock = clock

    @property
    def silent_s(self) -> float:
        return 0.0 if self.busy else self._clock.now_s - self.heard_s

    def lose(self, why: str) -> None:
        self.losses.append(why)

    async def ended(self) -> None:
        raise NotImplementedError

    def notify(self, notice: Notice) -> None:
        self.notices.append(notice)

    def end(self, error: DepthError) -> None:
        self.errors.append(error)


class StreamTableMachine(RuleBasedStateMachine):
    connections = Bundle("connections")

    def __init__(self) -> None:
        super().__init__()
        self.clock = ManualClock()
        self.registry = CollectorRegistry()
        self.opened: list[Stream] = []
        self.closed: list[Stream] = []
        metrics = Metrics(self.registry)
        self.memory = MemoryBudget(MEMORY, metrics=metrics)
        self.table = StreamTable(
            capacity=CAPACITY,
            quotas=Quotas(streams_per_client=PER_CLIENT),
            memory=self.memory,
            idle_timeout_s=IDLE_S,
            idle_notice_s=NOTICE_S,
            detach_grace_s=GRACE_S,
            silent_s=SILENT_S,
            clock=self.clock,
            metrics=metrics,
            on_closed=self.closed.append,
        )
        # What the table should hold: per open stream its size, whose it is and since when it is
        # unused; when each expired one expired; and who is attached to what.
        self.sizes: dict[str, int] = {}
        self.clients: dict[str, str] = {}
        self.used_s: dict[str, float] = {}
        self.expired_s: dict[str, float] = {}
        self.owner: dict[str, Connection | None] = {}
        self.streams: dict[str, Stream] = {}
        # Connections without a stream that have not ended, and whose they are.
        self.leaving: dict[Connection, str] = {}
        self.silent: set[Connection] = set()

    def settle(self) -> None:
        """Expire in the model what is due by now."""
        for stream_id in list(self.sizes):
            owner = self.owner[stream_id]
            if owner is not None and owner.busy:
                self.used_s[stream_id] = self.clock.now_s
            patience_s = IDLE_S if owner else GRACE_S
            if self.clock.now_s >= self.used_s[stream_id] + patience_s:
                self.forget(stream_id)
                self.expired_s[stream_id] = self.clock.now_s
            elif owner is not None and owner.silent_s >= SILENT_S:
                self.silent.add(owner)

    def forget(self, stream_id: str) -> None:
        if (owner := self.owner[stream_id]) is not None:
            self.leaving[owner] = self.clients[stream_id]
        for table in (self.sizes, self.clients, self.used_s, self.owner, self.streams):
            table.pop(stream_id)

    def next_expiry_s(self, client: str) -> float:
        """Time until the first stream of an address expires; 1 s if only connections end."""
        return (
            min(
                (
                    self.used_s[stream_id] + (IDLE_S if self.owner[stream_id] else GRACE_S)
                    for stream_id, of in self.clients.items()
                    if of == client
                ),
                default=self.clock.now_s + 1.0,
            )
            - self.clock.now_s
        )

    def open_in_table(
        self, stream_id: str, size: int, client: str, connection: Connection
    ) -> Stream:
        need = StreamMemory(state=size, work=0, maps=0, step=0)
        with self.table.reserve(stream_id, need, client=client) as place:
            return self.table.open(place, RIG_OPENING, RECTIFIER, attachment=connection)

    @rule(
        target=connections,
        stream_id=st.sampled_from("abcde"),
        size=st.sampled_from([1, STATE]),
        client=st.sampled_from(["", "10.0.0.1", "10.0.0.2"]),
    )
    def open(self, stream_id: str, size: int, client: str) -> Connection:
        self.table.sweep()
        self.settle()
        connection = Connection(self.clock)
        expected: type[DepthError] | None = None
        if stream_id in self.sizes:
            expected = StreamExists
        elif client and self.count(client) >= PER_CLIENT:
            expected = Quota
        elif len(self.sizes) + len(self.leaving) >= CAPACITY:
            expected = StreamLimit
        elif sum(self.sizes.values()) + size > MEMORY:
            expected = StateMemory
        if expected is not None:
            with pytest.raises(expected) as refusal:
                self.open_in_table(stream_id, size, client, connection)
            retry_s = refusal.value.retry_after_s
            assert retry_s is None or 0 < retry_s <= IDLE_S
            if expected is Quota:  # room comes from this address, not from others
                assert retry_s == pytest.approx(self.next_expiry_s(client))
            return connection
        stream = self.open_in_table(stream_id, size, client, connection)
        self.sizes[stream_id] = size
        self.clients[stream_id] = client
        self.used_s[stream_id] = self.clock.now_s
        self.expired_s.pop(stream_id, None)
        self.owner[stream_id] = connection
        self.streams[stream_id] = connection.stream = stream
        self.opened.append(stream)
        return connection

    def count(self, client: str) -> int:
        return [*self.clients.values(), *self.leaving.values()].count(client)

    @rule(stream_id=st.sampled_from("abcde"), other_id=st.sampled_from("fgh"))
    def give_up_while_it_opens(self, stream_id: str, other_id: str) -> None:
        self.table.sweep()
        self.settle()
        need = StreamMemory(state=1, work=0, maps=0, step=0)
        taken = len(self.sizes) + len(self.leaving)
        if stream_id in self.sizes or taken >= CAPACITY or sum(self.sizes.values()) >= MEMORY:
            return
        with self.table.reserve(stream_id, need, client=""):
            assert self.memory.used(MemoryKind.STATE) == sum(self.sizes.values()) + 1
            with pytest.raises(StreamExists), self.table.reserve(stream_id, need, client=""):
                pass
            if taken + 1 == CAPACITY:
                with pytest.raises(StreamLimit), self.table.reserve(other_id, need, client=""):
                    pass

    @rule(stream_id=st.sampled_from("abcde"))
    def use(self, stream_id: str) -> None:
        self.table.sweep()
        self.settle()
        if stream_id in self.sizes:
            stream = self.table.get(stream_id)
            assert stream is self.streams[stream_id]
            self.table.touch(stream)
            self.used_s[stream_id] = self.clock.now_s
        else:
            known = self.clock.now_s - self.expired_s.get(stream_id, -1e9) <= TOMBSTONE_S
            with pytest.raises(StreamExpired if known else UnknownStream):
                self.table.get(stream_id)

    @rule(connection=connections)
    def lose_connection(self, connection: Connection) -> None:
        self.settle()
        if connection.stream is not None:
            self.table.detach(connection.stream, connection)
        self.leaving.pop(connection, None)
        for stream_id in self.streams:
            if self.owner[stream_id] is connection:
                self.owner[stream_id] = None
                self.used_s[stream_id] = self.clock.now_s

    @rule(
        target=connections,
        stream_id=st.sampled_from("abcde"),
        right_token=st.booleans(),
        client=st.sampled_from(["10.0.0.1", "10.0.0.3"]),
    )
    def resume(self, stream_id: str, right_token: bool, client: str) -> Connection:
        self.settle()
        connection = Connection(self.clock)
        if stream_id not in self.sizes:
            with pytest.raises((StreamExpired, UnknownStream)):
                self.attach(stream_id, b"any", client, connection)
            return connection
        stream, before = self.streams[stream_id], self.owner[stream_id]
        if not right_token:
            with pytest.raises(StreamExists):
                self.attach(stream_id, b"guess", client, connection)
            assert stream.attachment is before
            return connection
        self.attach(stream_id, stream.resume_token, client, connection)
        connection.stream = stream
        if before is not None:
            self.leaving[before] = self.clients[stream_id]
            assert isinstance(before.errors[-1], Superseded)
        self.clients[stream_id] = client
        self.owner[stream_id] = connection
        self.used_s[stream_id] = self.clock.now_s
        return connection

    def attach(self, stream_id: str, token: bytes, client: str, connection: Connection) -> None:
        self.table.attach(stream_id, token, RIG_OPENING, attachment=connection, client=client)

    @rule(stream_id=st.sampled_from("abcde"))
    def close(self, stream_id: str) -> None:
        self.settle()
        if stream_id in self.sizes:
            self.table.close(self.streams[stream_id])
            self.forget(stream_id)

    @rule(connection=connections, busy=st.booleans())
    def hear_from(self, connection: Connection, busy: bool) -> None:
        connection.busy, connection.heard_s = busy, self.clock.now_s

    @rule(seconds=st.sampled_from([1.0, 9.0, 11.0, 51.0, 61.0, 301.0]))
    def wait(self, seconds: float) -> None:
        self.clock.advance(seconds)

    @invariant()
    def the_table_holds_what_it_should(self) -> None:
        self.table.sweep()
        self.settle()
        assert len(self.table) == len(self.sizes)
        assert self.registry.get_sample_value("vergence_streams_open") == len(self.sizes)
        assert self.memory.used(MemoryKind.STATE) == sum(self.sizes.values())
        for stream_id, stream in self.streams.items():
            owner = self.owner[stream_id]
            assert stream.attachment is owner
            if owner is not None:
                assert bool(owner.losses) == (owner in self.silent)
                assert not owner.busy or self.table.idle_s(stream) == 0
        opened, closed = (
            self.registry.get_sample_value(f"vergence_streams_{what}_total")
            for what in ("opened", "closed")
        )
        assert (opened, closed) == (len(self.opened), len(self.opened) - len(self.sizes))
        ended = [stream for stream in self.opened if stream not in self.streams.values()]
        assert sorted(map(id, self.closed)) == sorted(map(id, ended)), "each is reported once"


StreamTableMachine.TestCase.settings = settings(
    max_examples=40, stateful_step_count=30, deadline=None
)
TestStreamTable = StreamTableMachine.TestCase
