"""Servers and streams that exist as events only: what a fleet does, from the costs of one server.

A server has lanes. A frame waits for a free lane; a newer frame of its stream displaces it. Streams
take turns. A frame that has the whole server to itself is stepped on all lanes. A stream goes to a
server by Envoy's ring of hashes.
"""

import hashlib
import heapq
import math
import random
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial


@dataclass(frozen=True, slots=True)
class Costs:
    """What was measured on one server."""

    alone_s: tuple[float, ...]  # times of frames that have the whole server to themselves
    beside_s: tuple[float, ...]  # times of one lane for a frame, beside others
    transport_s: float
    gap_s: float  # from the death of a server until its streams send to another one
    start_s: float  # from the decision for a new server until it serves


@dataclass(slots=True, eq=False)
class Stream:
    """A camera. Times are those of arrivals at the server."""

    stream_id: str
    hz: float
    server: "Server | None" = None
    waiting_s: float | None = None  # when its newest frame arrived
    queued: bool = False  # it waits for a lane, or has one
    closed: bool = False
    taken: int = 0
    answered: int = 0
    last_answer_s: float | None = None
    longest_gap_s: float = 0.0


@dataclass(slots=True, eq=False)
class Server:
    """``lanes`` steps run at once."""

    name: str
    lanes: int
    free: int = 0
    alive: bool = True
    turns: deque[Stream] = field(default_factory=deque)
    streams: set[Stream] = field(default_factory=set)


class Ring:
    """Envoy's RING_HASH: each server has the same number of points on a circle of hashes."""

    def __init__(self, servers: Sequence[Server], *, points: int = 1024) -> None:
        each = math.ceil(points / len(servers))
        ring = [
            (_hash(f"{server.name}_{number}"), server)
            for server in servers
            for number in range(each)
        ]
        ring.sort(key=lambda point: point[0])
        self._hashes = [point for point, _ in ring]
        self._servers = [server for _, server in ring]

    def server_of(self, stream_id: str, fits: Callable[[Server], bool]) -> Server:
        """Return the first server from the stream's hash on that ``fits``."""
        start = bisect_left(self._hashes, _hash(stream_id))
        for offset in range(len(self._servers)):
            server = self._servers[(start + offset) % len(self._servers)]
            if fits(server):
                return server
        raise LookupError("no server fits")


def _hash(text: str) -> int:
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest())


class SimulatedFleet:
    """Streams on servers behind a ring.

    ``balance``: Envoy's hash_balance_factor: a server above so many times the mean gets no stream.
    """

    def __init__(
        self,
        costs: Costs,
        *,
        servers: int,
        lanes: int,
        points: int = 1024,
        balance: float = math.inf,
        seed: int = 0,
    ) -> None:
        self.now_s = 0.0
        self.ages_s: list[tuple[float, float]] = []  # when an answer came, and its age
        self.streams: list[Stream] = []
        self.servers = [Server(f"10.0.0.{index}:50051", lanes, lanes) for index in range(servers)]
        self._costs, self._lanes, self._points, self._balance = costs, lanes, points, balance
        self._random = random.Random(seed)
        self._events: list[tuple[float, int, Callable[[], object]]] = []
        self._count = 0
        self._open = 0
        self._ring = Ring(self.servers, points=points)

    @property
    def alive(self) -> list[Server]:
        return [each for each in self.servers if each.alive]

    def at(self, time_s: float, action: Callable[[], object]) -> None:
        """Do something later."""
        self._count += 1
        heapq.heappush(self._events, (time_s, self._count, action))

    def run(self, until_s: float) -> None:
        """Let time pass."""
        while self._events and self._events[0][0] <= until_s:
            self.now_s, _, action = heapq.heappop(self._events)
            action()
        self.now_s = until_s

    def open(self, hz: float) -> Stream:
        """Open a stream, whose camera begins at any moment of its interval."""
        stream = Stream(f"{self._random.getrandbits(128):032x}", hz)
        self.streams.append(stream)
        self._open += 1
        self._place(stream)
        self.at(self.now_s + self._random.random() / hz, lambda: self._frame(stream))
        return stream

    def close(self, stream: Stream) -> None:
        """End a stream."""
        stream.closed = True
        self._open -= 1
        if stream.server is not None:
            stream.server.streams.discard(stream)

    def kill(self, server: Server) -> None:
        """End a server. Its streams go to others, after the gap."""
        server.alive = False
        lost = list(server.streams)
        server.streams.clear()
        self._ring = Ring(self.alive, points=self._points)
        for stream in lost:
            stream.server, stream.waiting_s, stream.queued = None, None, False
            self.at(self.now_s + self._costs.gap_s, partial(self._place, stream))

    def add(self) -> None:
        """Start a server. Streams that are open stay where they are."""

        def serve() -> None:
            name = f"10.0.0.{len(self.servers)}:50051"
            self.servers.append(Server(name, self._lanes, self._lanes))
            self._ring = Ring(self.alive, points=self._points)

        self.at(self.now_s + self._costs.start_s, serve)

    def _place(self, stream: Stream) -> None:
        if stream.closed:
            return
        most = self._balance * self._open / len(self.alive)
        stream.server = self._ring.server_of(
            stream.stream_id, lambda server: len(server.streams) < max(most, 1)
        )
        stream.server.streams.add(stream)

    def _frame(self, stream: Stream) -> None:
        if stream.closed:
            return
        self.at(self.now_s + 1 / stream.hz, lambda: self._frame(stream))
        stream.taken += 1
        if stream.server is None:
            return
        stream.waiting_s = self.now_s
        if not stream.queued:
            stream.queued = True
            stream.server.turns.append(stream)
            self._step(stream.server)

    def _step(self, server: Server) -> None:
        while server.free and server.turns:
            stream = server.turns.popleft()
            if stream.server is not server or stream.waiting_s is None:
                continue
            alone = server.free == server.lanes and not server.turns
            lanes = server.lanes if alone else 1
            took_s = self._random.choice(self._costs.alone_s if alone else self._costs.beside_s)
            server.free -= lanes
            arrived_s, stream.waiting_s = stream.waiting_s, None
            self.at(
                self.now_s + took_s,
                partial(self._done, server, stream, arrived_s, lanes),
            )

    def _done(self, server: Server, stream: Stream, arrived_s: float, lanes: int) -> None:
        server.free += lanes
        if server.alive and stream.server is server and not stream.closed:
            stream.answered += 1
            if stream.last_answer_s is not None:
                gap_s = self.now_s - stream.last_answer_s
                stream.longest_gap_s = max(stream.longest_gap_s, gap_s)
            stream.last_answer_s = self.now_s
            self.ages_s.append((self.now_s, self.now_s - arrived_s + self._costs.transport_s))
            stream.queued = stream.waiting_s is not None
            if stream.queued:
                server.turns.append(stream)
        self._step(server)
