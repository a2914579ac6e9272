"""The law of ordered work: results keep the order of the items, and the limit holds."""

import asyncio
from collections.abc import AsyncGenerator
from contextlib import aclosing

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vergence_proto.ordered import in_order


async def count_to(number: int) -> AsyncGenerator[int, None]:
    for each in range(number):
        yield each


@given(yields=st.lists(st.integers(0, 5), max_size=12), limit=st.integers(1, 4))
def test_results_come_in_the_order_of_the_items_whoever_is_done_first(
    yields: list[int], limit: int
) -> None:
    running = most = 0

    async def work(item: int) -> int:
        nonlocal running, most
        running += 1
        most = max(most, running)
        for _ in range(yields[item]):
            await asyncio.sleep(0)
        running -= 1
        return item

    async def collect() -> list[int]:
        return [result async for result in in_order(count_to(len(yields)), work, limit=limit)]

    assert asyncio.run(collect()) == list(range(len(yields)))
    assert most <= limit


async def test_closing_cancels_outstanding_work() -> None:
    cancelled: list[int] = []

    async def work(item: int) -> int:
        try:
            return item if item == 0 else await asyncio.Event().wait()
        except asyncio.CancelledError:
            cancelled.append(item)
            raise

    async with aclosing(in_order(count_to(9), work, limit=3)) as results:
        assert await anext(results) == 0
    assert cancelled == [1, 2]


async def test_closing_waits_for_outstanding_work_where_that_is_asked_for() -> None:
    finished: list[int] = []

    async def work(item: int) -> int:
        for _ in range(3 * item):
            await asyncio.sleep(0)
        finished.append(item)
        return item

    async with aclosing(in_order(count_to(9), work, limit=3, cancel_rest=False)) as results:
        assert await anext(results) == 0
    assert finished == [0, 1, 2]


@pytest.mark.parametrize("cancelled_times", [1, 2])
@pytest.mark.parametrize("outstanding", [1, 3])
async def test_a_cancelled_caller_waits_for_outstanding_work_where_that_is_asked_for(
    outstanding: int, cancelled_times: int
) -> None:
    """Also for the task whose result it was waiting for, and if it is cancelled again."""
    may_finish = asyncio.Event()
    all_begun = asyncio.Event()
    begun: list[int] = []
    finished: list[int] = []

    async def work(item: int) -> None:
        begun.append(item)
        if len(begun) == outstanding:
            all_begun.set()
        await may_finish.wait()
        finished.append(item)

    async def read_all() -> None:
        items = count_to(9)
        results = in_order(items, work, limit=outstanding, cancel_rest=False)
        async with aclosing(items), aclosing(results):
            async for _ in results:
                pass

    reading = asyncio.create_task(read_all())
    await all_begun.wait()
    for _ in range(cancelled_times):
        reading.cancel()
        await asyncio.wait([reading], timeout=0)
        assert not reading.done()
    may_finish.set()
    with pytest.raises(asyncio.CancelledError):
        await reading
    assert finished == list(range(outstanding))


async def test_a_cancelled_caller_cancels_outstanding_work() -> None:
    all_begun = asyncio.Event()
    cancelled: list[int] = []

    async def work(item: int) -> None:
        if item == 2:
            all_begun.set()
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            cancelled.append(item)
            raise

    async def read_all() -> None:
        async for _ in in_order(count_to(9), work, limit=3):
            pass

    reading = asyncio.create_task(read_all())
    await all_begun.wait()
    reading.cancel()
    with pytest.raises(asyncio.CancelledError):
        await reading
    assert cancelled == [0, 1, 2]


async def test_a_failure_of_the_work_is_raised_in_its_turn() -> None:
    async def work(item: int) -> int:
        if item == 1:
            raise ValueError("the second")
        return item

    results = in_order(count_to(3), work, limit=3)
    assert await anext(results) == 0
    with pytest.raises(ValueError, match="the second"):
        await anext(results)
