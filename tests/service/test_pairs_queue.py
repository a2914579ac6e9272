"""Single pairs wait in a bounded queue, and leave a lane to live streams."""

import asyncio

import httpx

from tests.support.http import http_to, metrics_of, pair_form, reason_of
from tests.support.models import RecallModel
from tests.support.polling import eventually, eventually_true, turns
from tests.support.server import running_server
from vergence_service.access.principals import LOCAL
from vergence_service.jobs.places import Places


async def test_pairs_beyond_the_queue_are_refused_with_a_time_to_come_back() -> None:
    model = RecallModel()
    async with running_server(model, limits__pairs=2) as server, http_to(server) as http:
        with model.busy():
            accepted = [asyncio.create_task(http.post("/v1/pairs", files=pair_form()))]
            await asyncio.to_thread(model.wait_until_entered)
            accepted.append(asyncio.create_task(http.post("/v1/pairs", files=pair_form())))

            async def is_full() -> bool:
                return "vergence_pairs 2.0" in (await metrics_of(http))

            await eventually_true(is_full)
            refusal = await http.post("/v1/pairs", files=pair_form())
            assert refusal.status_code == httpx.codes.TOO_MANY_REQUESTS
            assert reason_of(refusal) == "QUEUE_FULL"
            assert int(refusal.headers["Retry-After"]) >= 1
        answers = await asyncio.gather(*accepted)
        assert [answer.status_code for answer in answers] == [httpx.codes.OK] * 2
        assert (await http.post("/v1/pairs", files=pair_form())).status_code == httpx.codes.OK


async def test_a_client_that_leaves_gives_its_place_to_the_next() -> None:
    model = RecallModel()
    async with running_server(model, limits__pairs=1) as server:
        with model.busy():
            async with http_to(server) as leaving:
                left = asyncio.create_task(leaving.post("/v1/pairs", files=pair_form()))
                await asyncio.to_thread(model.wait_until_entered)
                left.cancel()
                await asyncio.wait([left])
            model.let_go()
        async with http_to(server) as http:

            async def answered() -> bool:
                answer = await http.post("/v1/pairs", files=pair_form())
                return answer.status_code == httpx.codes.OK

            await eventually_true(answered)


async def test_callers_work_one_at_a_time_in_the_order_in_which_they_came() -> None:
    places, order, may_go = Places(3), list[int](), asyncio.Event()

    async def caller(number: int) -> None:
        async with places.taken(LOCAL):
            order.append(number)
            await may_go.wait()

    callers = [asyncio.create_task(caller(number)) for number in range(3)]
    await eventually(lambda: order)
    await turns()
    assert order == [0]
    may_go.set()
    await asyncio.gather(*callers)
    assert order == [0, 1, 2]
