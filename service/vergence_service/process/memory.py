"""One budget for the memory that clients make the server use."""

import asyncio
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Self

from vergence_proto.errors import FrameTooLarge, StateMemory
from vergence_service.process.metrics import Metrics

if sys.platform != "win32":
    import resource

_MIB = 1 << 20
# Kept free below a limit of the process: the network buffers of gRPC end the process if they cannot
# be allocated, and every thread takes address space.
_KEPT_FREE = 384 * _MIB
_LEAST = 64 * _MIB


class TooLittleMemory(MemoryError):
    """The limit on the process leaves too little memory to serve."""

    def __init__(self, limit_bytes: int) -> None:
        super().__init__(
            f"the limit of {_mib(limit_bytes)} on this process's address space leaves no memory "
            "for streams; raise it (ulimit -v)"
        )


class MemoryKind(StrEnum):
    """What memory is used for; the label of the metric."""

    STATE = "state"  # recurrent states
    WORK = "work"  # images and maps of the frame that a stream has in hand
    MAPS = "maps"  # for the rectification
    FRAMES = "frames"  # frames that wait, as they arrived
    STEPS = "steps"  # the network


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamMemory:
    """The bytes that one stream needs."""

    state: int
    work: int
    maps: int
    step: int  # the peak of its largest step; several streams need it once

    @property
    def own(self) -> int:
        """What no other stream uses too."""
        return self.state + self.work + self.maps

    @property
    def total(self) -> int:
        return self.own + self.step


class MemoryHold:
    """Memory that is reserved until :meth:`release`, or until the end of a ``with`` block."""

    def __init__(
        self, budget: "MemoryBudget", held: dict[MemoryKind, int], step: int | None
    ) -> None:
        self._budget = budget
        self._held = held
        self._step = step

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.release()

    @property
    def nbytes(self) -> int:
        """What is reserved, without steps."""
        return sum(self._held.values())

    def grow(self, nbytes: int) -> None:
        """Reserve more, for a frame that still arrives. Raises StateMemory if it does not fit."""
        self._budget.take_for_frame(nbytes)
        self._held[MemoryKind.FRAMES] += nbytes

    def release(self) -> None:
        """Give the memory back; more than once is no error."""
        held, step, self._held, self._step = self._held, self._step, {}, None
        self._budget.give_back(held, step)


class MemoryBudget:
    """Reserves memory, up to ``limit_bytes`` together. It belongs to the event loop.

    What a step of the network needs is reserved once, for the largest step of all streams. More
    steps run side by side only in the memory that nothing else uses.
    """

    def __init__(self, limit_bytes: int, *, metrics: Metrics) -> None:
        self._limit = limit_bytes
        self._held = dict.fromkeys(MemoryKind, 0)
        self._largest_steps: list[int] = []  # of every stream
        self._running = 0  # bytes of the steps that run
        self._freed = asyncio.Event()
        self._metrics = metrics
        metrics.memory_limit_bytes.set(limit_bytes)
        for kind in MemoryKind:
            metrics.memory_bytes.labels(kind).set_function(partial(self.used, kind))

    def reduce_to(self, limit_bytes: int) -> None:
        """Lower the limit, before anything is reserved."""
        self._limit = min(self._limit, limit_bytes)
        self._metrics.memory_limit_bytes.set(self._limit)

    def used(self, kind: MemoryKind) -> int:
        """Return the bytes that are reserved for one kind."""
        if kind is MemoryKind.STEPS:
            return max([self._running, *self._largest_steps])
        return self._held[kind]

    def check_possible(self, need: StreamMemory) -> None:
        """Raise FrameTooLarge if a stream needs more than the whole budget."""
        if need.total > self._limit:
            raise FrameTooLarge(
                f"images of this size need {_mib(need.total)} of memory, and the server's limit is "
                f"{_mib(self._limit)}; send smaller images, or start the server with a larger "
                "limits.max_state_mib"
            )

    def hold_stream(self, need: StreamMemory) -> MemoryHold:
        """Reserve what a stream needs.

        Raises FrameTooLarge if it is more than the whole budget, and StateMemory if other streams
        use too much of it.
        """
        self.check_possible(need)
        steps = self.used(MemoryKind.STEPS)
        used = self._used_beside_steps() + steps
        more = need.own + max(need.step - steps, 0)
        if used + more > self._limit:
            raise StateMemory(
                f"the stream needs {_mib(more)} of memory; {_mib(used)} of {_mib(self._limit)} are "
                "in use; close a stream, or try again later (the server's "
                "setting limits.max_state_mib)"
            )
        held = {
            MemoryKind.STATE: need.state,
            MemoryKind.WORK: need.work,
            MemoryKind.MAPS: need.maps,
        }
        for kind, nbytes in held.items():
            self._held[kind] += nbytes
        self._largest_steps.append(need.step)
        return MemoryHold(self, held, need.step)

    def hold_frame(self, nbytes: int) -> MemoryHold:
        """Reserve what a frame keeps while it waits. Raises StateMemory if it does not fit."""
        self.take_for_frame(nbytes)
        return MemoryHold(self, {MemoryKind.FRAMES: nbytes}, None)

    async def wait_for_frame(self, nbytes: int) -> MemoryHold:
        """Reserve what a frame keeps, and wait for it while other frames have it.

        Raises StateMemory if it does not fit although no frame waits.
        """
        while not self._fits(nbytes) and self._held[MemoryKind.FRAMES]:
            self._freed.clear()
            await self._freed.wait()
        return self.hold_frame(nbytes)

    async def wait_for_stream(self, need: StreamMemory) -> MemoryHold:
        """Reserve what a stream needs, and wait for it while other streams have it.

        Raises FrameTooLarge if it is more than the whole budget.
        """
        while True:
            try:
                return self.hold_stream(need)
            except StateMemory:
                self._freed.clear()
                await self._freed.wait()

    def may_step(self, nbytes: int) -> bool:
        """Decide whether a step may run now, beside those that run."""
        if self._running == 0:
            return True
        allowed = max([self._limit - self._used_beside_steps(), *self._largest_steps])
        return self._running + nbytes <= allowed

    @contextmanager
    def stepping(self, nbytes: int) -> Iterator[None]:
        """Count a step that runs during the block."""
        self._running += nbytes
        try:
            yield
        finally:
            self._running -= nbytes
            self._freed.set()

    def take_for_frame(self, nbytes: int) -> None:
        """Count what a hold gets; only a hold calls this. Raises StateMemory if it does not fit."""
        if not self._fits(nbytes):
            raise StateMemory(
                f"the server has no memory for another frame of {nbytes} bytes; try again later"
            )
        self._held[MemoryKind.FRAMES] += nbytes

    def give_back(self, held: dict[MemoryKind, int], step: int | None) -> None:
        """Take back what a hold had; only the hold itself calls this."""
        for kind, nbytes in held.items():
            self._held[kind] -= nbytes
        if step is not None:
            self._largest_steps.remove(step)
        self._freed.set()

    def _fits(self, nbytes: int) -> bool:
        used = self._used_beside_steps() + self.used(MemoryKind.STEPS)
        return used + nbytes <= self._limit

    def _used_beside_steps(self) -> int:
        return sum(self._held.values())


def affordable_bytes(wanted: int) -> int:
    """Return how many bytes the budget can have, ``wanted`` at most.

    A limit on the address space of the process (``ulimit -v``) leaves less. Call it when the model
    is loaded. Raises TooLittleMemory if it leaves almost none.
    """
    if sys.platform != "linux":
        return wanted
    soft, _ = resource.getrlimit(resource.RLIMIT_AS)
    if soft == resource.RLIM_INFINITY:
        return wanted
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    left = soft - pages * resource.getpagesize() - _KEPT_FREE
    if left < _LEAST:
        raise TooLittleMemory(soft)
    return min(wanted, left)


def _mib(nbytes: int) -> str:
    return f"{nbytes / _MIB:.1f} MiB"
