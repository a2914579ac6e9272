"""Every request, allowed by the schema or not, is answered as the schema says."""

import asyncio
import threading
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import pytest
import schemathesis
from hypothesis import HealthCheck, given, settings
from hypothesis.errors import Unsatisfiable
from schemathesis import CheckFunction, GenerationMode
from schemathesis.core.result import Ok
from schemathesis.openapi import from_url
from schemathesis.specs.openapi.checks import negative_data_rejection, positive_data_acceptance

from tests.support.models import RecallModel
from tests.support.server import running_server


@schemathesis.serializer("application/x-protobuf", "application/offset+octet-stream")
def as_it_is(context: schemathesis.SerializationContext, content: bytes) -> bytes:
    return content


Case = schemathesis.Case[Any]
LISTS = {"label", "output", "state"}  # parameters that may be given several times


@pytest.fixture(scope="module")
def api() -> Iterator[schemathesis.BaseSchema]:
    """The schema of a running server, which runs in a thread with its own loop."""
    address: list[str] = []
    started, stop = threading.Event(), threading.Event()

    async def serve() -> None:
        async with running_server(RecallModel(), batch__idle_s=2.0) as server:
            address.append(server.http_address)
            started.set()
            await asyncio.to_thread(stop.wait)

    thread = threading.Thread(target=asyncio.run, args=(serve(),))
    thread.start()
    assert started.wait(timeout=20)
    try:
        yield from_url(f"http://{address[0]}/openapi.json")
    finally:
        stop.set()
        thread.join(timeout=20)


@pytest.mark.parametrize(
    ("mode", "examples"),
    [
        pytest.param(GenerationMode.POSITIVE, 3, id="a few allowed"),
        pytest.param(GenerationMode.POSITIVE, 15, id="allowed", marks=pytest.mark.slow),
        pytest.param(GenerationMode.NEGATIVE, 15, id="not allowed", marks=pytest.mark.slow),
    ],
)
def test_every_operation_answers_as_the_schema_says(
    api: schemathesis.BaseSchema, mode: GenerationMode, examples: int
) -> None:
    """The examples are of every operation."""
    checked = []
    for operation in (each.ok() for each in api.get_all_operations() if isinstance(each, Ok)):

        @given(case=operation.as_strategy(generation_mode=mode))
        @settings(max_examples=examples, deadline=None, suppress_health_check=list(HealthCheck))
        def answers(case: Case) -> None:
            # That bytes are a sequence, or images of one size, is more than a schema can say.
            excluded: list[CheckFunction] = []
            # And a token belongs to one list.
            if case.method in ("PATCH", "POST") or "page_token" in (case.query or {}):
                excluded.append(positive_data_acceptance)
            # In a query, a text and a list of it are the same.
            query = dict(case.query or {})
            if LISTS & set(query) or any(isinstance(each, list) for each in query.values()):
                excluded.append(negative_data_rejection)
            case.call_and_validate(timeout=20, excluded_checks=excluded)

        # Where every string is allowed and nothing else is taken, nothing can be wrong.
        with suppress(Unsatisfiable):
            answers()
            checked.append(operation.label)
    assert len(checked) >= {GenerationMode.POSITIVE: 10, GenerationMode.NEGATIVE: 3}[mode], checked
