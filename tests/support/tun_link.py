"""A bad link between two network namespaces, with the kernel's own TCP at both ends.

Two TUN devices, and a process that carries the packets between them: at a rate, with a queue that
drops what does not fit, delay, jitter that keeps the order, and stalls that hold everything back as
a radio does. It needs root and /dev/net/tun.
"""

import dataclasses
import fcntl
import gc
import json
import os
import random
import select
import struct
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

CLIENT_IP, SERVER_IP = "10.77.0.1", "10.77.0.2"
_MOVED_IP = "10.77.0.3"
_TUNSETIFF = 0x400454CA
_IFF_TUN, _IFF_NO_PI = 0x0001, 0x1000
_MTU = 1500
_BURST = 64  # packets that are read before those that are due are written
_REPOSITORY = Path(__file__).parents[2]


@dataclass(frozen=True, slots=True)
class LinkShape:
    """What a link does to packets, the same in both directions. A rate of 0 has no limit."""

    rate_mbit: float = 0.0
    delay_ms: float = 0.0
    jitter_ms: float = 0.0
    queue_ms: float = 100.0
    stall_every_s: float = 0.0
    stall_ms: float = 0.0


class Direction:
    """The packets on their way in one direction. Times are seconds of any clock."""

    def __init__(self, shape: LinkShape, *, started_s: float, seed: int) -> None:
        self._shape = shape
        self._started_s = started_s
        self._chance = random.Random(seed)
        self._free_s = self._last_due_s = started_s
        self._packets: deque[tuple[float, bytes]] = deque()

    def put(self, packet: bytes, now_s: float) -> None:
        """Take a packet, or drop it if the queue is full."""
        shape = self._shape
        start_s = max(now_s, self._free_s)
        if self.room_in_s(now_s) > 0:
            return
        self._free_s = start_s
        if shape.rate_mbit:
            self._free_s += len(packet) * 8e-6 / shape.rate_mbit
        flight_ms = shape.delay_ms + shape.jitter_ms * self._chance.uniform(-1, 1)
        due_s = self._after_stall(self._free_s + flight_ms * 1e-3)
        self._last_due_s = max(due_s, self._last_due_s)
        self._packets.append((self._last_due_s, packet))

    def room_in_s(self, now_s: float) -> float:
        """Return in how many seconds the queue takes another packet; 0: it does now."""
        return max(self._free_s - now_s - self._shape.queue_ms * 1e-3, 0.0)

    def _after_stall(self, due_s: float) -> float:
        shape = self._shape
        if not shape.stall_every_s:
            return due_s
        into_s = (due_s - self._started_s) % shape.stall_every_s
        # The first stall comes after one whole period.
        if due_s - self._started_s < shape.stall_every_s or into_s >= shape.stall_ms * 1e-3:
            return due_s
        return due_s - into_s + shape.stall_ms * 1e-3

    def take(self, now_s: float) -> bytes | None:
        """Return the next packet if it has arrived."""
        if self._packets and self._packets[0][0] <= now_s:
            return self._packets.popleft()[1]
        return None

    @property
    def next_due_s(self) -> float:
        """Return when the next packet arrives."""
        return self._packets[0][0] if self._packets else float("inf")


class TunLink:
    """A running link. ``client`` and ``server`` are the command prefixes of its two ends."""

    def __init__(self, process: "subprocess.Popen[str]", namespaces: tuple[str, str]) -> None:
        self._process = process
        self.client, self.server = (("ip", "netns", "exec", name) for name in namespaces)
        self.started_s = 0.0

    def cut(self, seconds: float) -> None:
        """Drop every packet for so long."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{seconds}\n")
        self._process.stdin.flush()

    def move_client(self) -> None:
        """Give the client another address, as a headset gets that walks to another access point."""
        name = self.client[-1]
        device = f"vg{self._process.pid % 100_000}a"
        _run("ip", "-n", name, "addr", "del", f"{CLIENT_IP}/24", "dev", device)
        _run("ip", "-n", name, "addr", "add", f"{_MOVED_IP}/24", "dev", device)
        _route(name, device, _MOVED_IP)


def can_make_links() -> bool:
    """Return True if this process may make network namespaces and TUN devices."""
    return os.geteuid() == 0 and Path("/dev/net/tun").exists()


@contextmanager
def tun_link(shape: LinkShape) -> Iterator[TunLink]:
    """Make two namespaces with a link between them, for the length of the block."""
    namespaces = (f"vergence{os.getpid()}a", f"vergence{os.getpid()}b")
    try:
        for name in namespaces:
            _run("ip", "netns", "add", name)
            _run("ip", "-n", name, "link", "set", "lo", "up")
        command = [sys.executable, "-m", "tests.support.tun_link", *namespaces]
        command.append(json.dumps(dataclasses.asdict(shape)))
        with subprocess.Popen(
            command, cwd=_REPOSITORY, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as process:
            assert process.stdout is not None
            link = TunLink(process, namespaces)
            link.started_s = float(process.stdout.readline())
            try:
                yield link
            finally:
                process.terminate()
    finally:
        for name in namespaces:
            with suppress(subprocess.CalledProcessError):
                _run("ip", "netns", "del", name)


def _run(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True)


def _tun(name: str, namespace: str, ip: str) -> int:
    descriptor = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    request = struct.pack("16sH22x", name.encode(), _IFF_TUN | _IFF_NO_PI)
    fcntl.ioctl(descriptor, _TUNSETIFF, request)
    _run("ip", "link", "set", name, "netns", namespace)
    _run("ip", "-n", namespace, "addr", "add", f"{ip}/24", "dev", name)
    _run("ip", "-n", namespace, "link", "set", name, "mtu", str(_MTU), "txqueuelen", "1000", "up")
    _route(namespace, name, ip)
    return descriptor


def _route(namespace: str, device: str, ip: str) -> None:
    # Every system has cubic; another default would make figures of two machines differ.
    net = ip.rpartition(".")[0] + ".0/24"
    _run("ip", "-n", namespace, "route", "replace", net, "dev", device, "congctl", "cubic")


def _carry(ends: tuple[int, int], shape: LinkShape) -> None:
    started_s = time.monotonic()
    ways = [Direction(shape, started_s=started_s, seed=seed) for seed in (1, 2)]
    print(started_s, flush=True)  # noqa: T201  the parent reads it
    cut_until_s = 0.0
    gc.disable()  # a pause would be one of the link
    while True:
        wait_s = min(way.next_due_s for way in ways) - time.monotonic()
        ready, _, _ = select.select((*ends, sys.stdin), (), (), min(max(wait_s, 0.0), 1.0))
        if sys.stdin in ready:
            line = sys.stdin.readline()
            if not line:
                return
            cut_until_s = time.monotonic() + float(line)
        for end, way in zip(ends, ways, strict=True):
            if end in ready:
                _read(end, way, cut_until_s)
        now_s = time.monotonic()
        for other, way in zip(reversed(ends), ways, strict=True):
            while (packet := way.take(now_s)) is not None:
                if now_s >= cut_until_s:
                    with suppress(BlockingIOError):
                        os.write(other, packet)


def _read(end: int, way: Direction, cut_until_s: float) -> None:
    with suppress(BlockingIOError):
        for _ in range(_BURST):
            packet = os.read(end, 2048)
            now_s = time.monotonic()
            if now_s >= cut_until_s:
                way.put(packet, now_s)


def main() -> None:
    """Carry packets until the standard input ends or a signal comes."""
    client, server, shape = sys.argv[1:]
    with suppress(PermissionError):
        os.nice(-10)  # a busy machine must not be a part of the link
    name = f"vg{os.getpid() % 100_000}"
    ends = (_tun(f"{name}a", client, CLIENT_IP), _tun(f"{name}b", server, SERVER_IP))
    _carry(ends, LinkShape(**json.loads(shape)))


if __name__ == "__main__":
    main()
