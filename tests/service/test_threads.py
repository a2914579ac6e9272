"""Work of one kind never waits for work of another kind, and long work can be stopped."""

import asyncio
import os
import re
import sys
import threading
from collections.abc import Iterator
from contextlib import aclosing
from pathlib import Path

import pytest

from tests.support.polling import turns
from vergence_service.process.threads import ThreadPool, Threads, to_the_end

SERVICE = Path(__file__).parents[2] / "service" / "vergence_service"


class Gate:
    """Work that has begun and ends when the test says so."""

    def __init__(self) -> None:
        self.begun, self._open = threading.Event(), threading.Event()

    def pass_through(self) -> str:
        self.begun.set()
        assert self._open.wait(timeout=30)
        return "through"

    def open(self) -> None:
        self._open.set()


async def held(pool: ThreadPool, count: int) -> tuple[list[Gate], list[asyncio.Task[str]]]:
    """Take ``count`` threads of a pool."""
    gates = [Gate() for _ in range(count)]
    tasks = [asyncio.create_task(pool.run(gate.pass_through)) for gate in gates]
    for gate in gates:
        await asyncio.to_thread(gate.begun.wait, 30)
    return gates, tasks


async def test_live_work_never_waits_for_background_work() -> None:
    async with Threads(lanes=1) as threads:
        gates, tasks = await held(threads.background, 2)
        queued = [asyncio.create_task(threads.background.run(str, n)) for n in range(20)]
        assert await asyncio.wait_for(threads.live.run(str, "live"), 30) == "live"
        assert not any(task.done() for task in (*tasks, *queued))
        for gate in gates:
            gate.open()
        assert await asyncio.gather(*queued) == [str(n) for n in range(20)]


async def test_long_work_takes_turns_with_work_that_comes_later() -> None:
    endless = iter(int, 1)
    async with ThreadPool(1, name="one") as pool, aclosing(pool.iterate(endless)) as pieces:
        assert await anext(pieces) == 0
        assert await asyncio.wait_for(pool.run(str, "later"), 30) == "later"


async def test_work_that_is_given_up_stops_after_its_piece_and_closes() -> None:
    closed, done = threading.Event(), [0]

    def work() -> Iterator[None]:
        try:
            while True:
                done[0] += 1
                yield
        finally:
            closed.set()

    async with ThreadPool(1, name="one") as pool:
        working = asyncio.create_task(pool.finish(work()))
        while not done[0]:  # noqa: ASYNC110  the work is in a thread
            await asyncio.sleep(0)
        working.cancel()
        await asyncio.wait([working])
        assert working.cancelled()
        assert closed.is_set()
        before = done[0]
        await pool.run(str)
        assert done[0] == before


async def test_the_failure_of_long_work_comes_after_its_results() -> None:
    def work() -> Iterator[int]:
        yield from (1, 2)
        raise OSError("full")

    async with ThreadPool(1, name="one") as pool:
        pieces = pool.iterate(work())
        assert [await anext(pieces), await anext(pieces)] == [1, 2]
        with pytest.raises(OSError, match="full"):
            await anext(pieces)


async def test_a_cancelled_caller_returns_only_after_its_thread() -> None:
    async with ThreadPool(1, name="one") as pool:
        [gate], [task] = await held(pool, 1)
        waiting = asyncio.create_task(pool.run(gate.pass_through))
        await turns()
        waiting.cancel()  # it has not begun: nothing to wait for
        await asyncio.wait([waiting])
        task.cancel()
        await turns()
        assert not task.done()
        gate.open()
        await asyncio.wait([task])
        assert task.cancelled()


async def test_work_to_the_end_is_done_although_its_caller_is_cancelled() -> None:
    begun, may_end, done = asyncio.Event(), asyncio.Event(), []

    async def work() -> None:
        begun.set()
        await may_end.wait()
        done.append("all")

    caller = asyncio.create_task(to_the_end(work()))
    await begun.wait()
    caller.cancel()
    await turns()
    assert not caller.done()
    may_end.set()
    await asyncio.wait([caller])
    assert caller.cancelled()
    assert done == ["all"]


async def test_the_number_of_threads_does_not_depend_on_the_work() -> None:
    async with Threads(lanes=3) as threads:
        before = threading.active_count()
        await asyncio.gather(*(threads.background.run(str, n) for n in range(50)))
        await asyncio.gather(*(threads.live.run(str, n) for n in range(50)))
        assert threading.active_count() == before


@pytest.mark.skipif(sys.platform != "linux", reason="threads have priorities of their own on Linux")
async def test_background_work_has_a_lower_priority() -> None:
    def niceness() -> int:
        return os.getpriority(os.PRIO_PROCESS, threading.get_native_id())

    async with Threads(lanes=1) as threads:
        live, background = await asyncio.gather(
            threads.live.run(niceness), threads.background.run(niceness)
        )
    assert background > live == os.getpriority(os.PRIO_PROCESS, 0)


def test_the_service_works_in_no_other_threads() -> None:
    found = {
        str(path.relative_to(SERVICE))
        for path in SERVICE.rglob("*.py")
        if re.search(r"\bto_thread\(|run_in_executor\(None|ThreadPoolExecutor\(", path.read_text())
    }
    # The batcher and the graphs own the threads of the model.
    assert found == {"process/threads.py", "inference/batcher.py", "inference/graphs.py"}
