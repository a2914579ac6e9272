"""One budget: what is reserved never exceeds it, and everything comes back."""

import asyncio
import subprocess
import sys

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, invariant, multiple, rule
from prometheus_client import CollectorRegistry

from tests.support.polling import turns
from vergence_proto.errors import FrameTooLarge, StateMemory
from vergence_service.process.memory import MemoryBudget, MemoryHold, MemoryKind, StreamMemory
from vergence_service.process.metrics import Metrics

LIMIT = 100
NBYTES = st.integers(0, 40)


def budget(limit: int = LIMIT) -> MemoryBudget:
    return MemoryBudget(limit, metrics=Metrics(CollectorRegistry()))


def stream(state: int = 0, work: int = 0, maps: int = 0, step: int = 0) -> StreamMemory:
    return StreamMemory(state=state, work=work, maps=maps, step=step)


class BudgetMachine(RuleBasedStateMachine):
    holds = Bundle("holds")

    def __init__(self) -> None:
        super().__init__()
        self.registry = CollectorRegistry()
        self.budget = MemoryBudget(LIMIT, metrics=Metrics(self.registry))
        self.frames: dict[MemoryHold, int] = {}
        self.streams: dict[MemoryHold, StreamMemory] = {}

    def expected(self) -> dict[MemoryKind, int]:
        streams = self.streams.values()
        return {
            MemoryKind.STATE: sum(each.state for each in streams),
            MemoryKind.WORK: sum(each.work for each in streams),
            MemoryKind.MAPS: sum(each.maps for each in streams),
            MemoryKind.FRAMES: sum(self.frames.values()),
            MemoryKind.STEPS: max((each.step for each in streams), default=0),
        }

    @rule(target=holds, nbytes=NBYTES)
    def hold_frame(self, nbytes: int) -> object:
        if sum(self.expected().values()) + nbytes > LIMIT:
            with pytest.raises(StateMemory):
                self.budget.hold_frame(nbytes)
            return multiple()
        hold = self.budget.hold_frame(nbytes)
        self.frames[hold] = nbytes
        return hold

    @rule(target=holds, state=NBYTES, work=NBYTES, maps=NBYTES, step=NBYTES)
    def hold_stream(self, state: int, work: int, maps: int, step: int) -> object:
        need = stream(state, work, maps, step)
        used = self.expected()
        after = sum(used.values()) - used[MemoryKind.STEPS] + need.total - step
        if need.total > LIMIT or after + max(step, used[MemoryKind.STEPS]) > LIMIT:
            with pytest.raises(FrameTooLarge if need.total > LIMIT else StateMemory):
                self.budget.hold_stream(need)
            return multiple()
        hold = self.budget.hold_stream(need)
        self.streams[hold] = need
        return hold

    @rule(hold=holds, nbytes=NBYTES)
    def grow(self, hold: MemoryHold, nbytes: int) -> None:
        if hold in self.frames:
            if sum(self.expected().values()) + nbytes > LIMIT:
                with pytest.raises(StateMemory):
                    hold.grow(nbytes)
            else:
                hold.grow(nbytes)
                self.frames[hold] += nbytes

    @rule(hold=holds)
    def release(self, hold: MemoryHold) -> None:
        hold.release()
        hold.release()
        self.frames.pop(hold, None)
        self.streams.pop(hold, None)

    @invariant()
    def every_kind_is_counted_and_the_sum_is_within_the_limit(self) -> None:
        expected = self.expected()
        for kind, nbytes in expected.items():
            assert self.budget.used(kind) == nbytes
            labels = {"kind": kind.value}
            assert self.registry.get_sample_value("vergence_memory_bytes", labels) == nbytes
        assert sum(expected.values()) <= LIMIT


TestBudget = BudgetMachine.TestCase
TestBudget.settings = settings(stateful_step_count=20)


async def test_a_frame_waits_for_the_memory_of_other_frames_but_not_for_ever() -> None:
    memory = budget()
    first = memory.hold_frame(80)
    second = asyncio.create_task(memory.wait_for_frame(30))
    await turns(5)
    assert not second.done()
    first.release()
    (await second).release()
    with memory.hold_stream(stream(state=90)), pytest.raises(StateMemory, match="30 bytes"):
        await memory.wait_for_frame(30)


async def test_a_sequence_waits_for_the_memory_of_live_streams() -> None:
    memory = budget()
    live = memory.hold_stream(stream(state=60, step=20))
    waiting = asyncio.create_task(memory.wait_for_stream(stream(state=30, step=15)))
    await turns(5)
    assert not waiting.done()
    live.release()
    (await waiting).release()
    with pytest.raises(FrameTooLarge, match="send smaller images"):
        await memory.wait_for_stream(stream(state=90, step=20))


def test_steps_run_side_by_side_only_in_memory_that_nothing_else_uses() -> None:
    memory = budget()
    with memory.hold_stream(stream(state=10, step=40)), memory.stepping(40):
        assert memory.may_step(40)
        with memory.hold_frame(15):
            assert not memory.may_step(40)
        with memory.stepping(45):
            assert memory.used(MemoryKind.STEPS) == 85
            assert not memory.may_step(10)
    assert memory.may_step(1000), "one step always may: its stream reserved it"


_UNDER_A_LIMIT = """
import resource
from vergence_service.process.memory import TooLittleMemory, affordable_bytes

used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
print(affordable_bytes(1 << 40) == 1 << 40)
resource.setrlimit(resource.RLIMIT_AS, (used + (1 << 30),) * 2)
print(0 < affordable_bytes(1 << 40) < 1 << 30, affordable_bytes(1 << 20) == 1 << 20)
resource.setrlimit(resource.RLIMIT_AS, (used + (1 << 28), used + (1 << 30)))
try:
    affordable_bytes(1 << 30)
except TooLittleMemory as error:
    print("ulimit -v" in str(error))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the limit and /proc are Linux's")
def test_a_limit_on_the_address_space_leaves_less() -> None:
    done = subprocess.run(
        [sys.executable, "-c", _UNDER_A_LIMIT], capture_output=True, text=True, check=False
    )
    assert done.stdout.split() == ["True"] * 4, done.stderr
