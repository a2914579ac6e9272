"""Repeated submissions are accepted once, and lists come in pages."""

import asyncio
import base64
import hashlib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.support.http import ZIP, ended, http_server, http_to, reason_of, submit
from tests.support.models import RecallModel
from tests.support.polling import eventually
from tests.support.sequences import make_frames, sequence_files, zip_bytes
from tests.support.server import running_server
from tests.support.tokens import TokenFile, http_as

ARCHIVE = zip_bytes(sequence_files(make_frames(2)))
OTHER = ARCHIVE[:-60] + ARCHIVE[-59:] + b"x"  # of the same length


def headers(key: str, body: bytes | None = None) -> dict[str, str]:
    stated = {**ZIP, "Idempotency-Key": f'"{key}"'}
    if body is not None:
        digest = base64.b64encode(hashlib.sha256(body).digest()).decode()
        stated["Content-Digest"] = f"sha-256=:{digest}:"
    return stated


async def send(
    client: httpx.AsyncClient, body: bytes, stated: dict[str, str], **query: Any
) -> httpx.Response:
    return await client.post("/v1/sequences", params=query, content=body, headers=stated)


async def test_a_submission_with_a_key_is_accepted_once(tmp_path: Any) -> None:
    async with http_server(RecallModel(), batch__directory=tmp_path) as client:
        first = await send(client, ARCHIVE, headers("drive-17"))
        job_id = first.json()["id"]
        await ended(client, job_id)
        again = await send(client, ARCHIVE, headers("drive-17"))
        assert (again.status_code, again.json()["id"]) == (202, job_id)
        assert again.json()["state"] == "done"
        for body, query in ((OTHER, {}), (ARCHIVE, {"metrics": True}), (ARCHIVE[:-1], {})):
            for stated in (headers("drive-17"), headers("drive-17", body)):
                answer = await send(client, body, stated, **query)
                assert (answer.status_code, reason_of(answer)) == (422, "KEY_REUSED")
        assert (await send(client, ARCHIVE, headers("drive-18"))).json()["id"] != job_id
        damaged = await send(client, ARCHIVE, headers("drive-19", OTHER))
        assert (damaged.status_code, reason_of(damaged)) == (400, "BAD_SHAPE")
        assert "damaged" in damaged.text
        bad = await send(client, ARCHIVE, {**ZIP, "Idempotency-Key": "k" * 300})
        assert (bad.status_code, reason_of(bad)) == (400, "BAD_SHAPE")
    async with http_server(RecallModel(), batch__directory=tmp_path) as client:
        again = await send(client, ARCHIVE, headers("drive-17", ARCHIVE))
        assert again.json()["id"] == job_id
        await client.delete(f"/v1/sequences/{job_id}")
        assert (await send(client, ARCHIVE, headers("drive-17"))).json()["id"] != job_id


async def test_a_key_whose_first_request_is_under_way_is_a_conflict(tmp_path: Path) -> None:
    async with (
        running_server(RecallModel(), batch__directory=tmp_path) as server,
        http_to(server) as client,
    ):
        reader, writer = await asyncio.open_connection(*server.http_address.split(":"))
        head = (
            f"POST /v1/sequences HTTP/1.1\r\nHost: {server.http_address}\r\n"
            'Content-Type: application/zip\r\nIdempotency-Key: "k"\r\n'
            f"Content-Length: {len(ARCHIVE)}\r\n\r\n"
        )
        writer.write(head.encode() + ARCHIVE[:100])
        await writer.drain()
        await eventually(lambda: any((tmp_path / "incoming").iterdir()))
        answer = await send(client, b"PK", headers("k"))
        assert (answer.status_code, reason_of(answer)) == (409, "KEY_IN_USE")
        assert "Retry-After" in answer.headers
        writer.write(ARCHIVE[100:])
        assert b"202 Accepted" in await reader.readline()
        writer.close()


@asynccontextmanager
async def as_ana(folder: Path) -> AsyncIterator[httpx.AsyncClient]:
    """A client with a token: only those may list jobs."""
    file = TokenFile(folder / "tokens.toml", "ana")
    async with (
        running_server(RecallModel(), security__tokens=file.path) as server,
        http_as(server, file.shown("ana")) as client,
    ):
        yield client


async def test_pages_have_every_job_once_newest_first(tmp_path: Path) -> None:
    async with as_ana(tmp_path) as client:
        jobs = []
        for number in range(7):
            label = [f"robot:r{number % 2}", "site:hall"]
            jobs.append(await submit(client, ARCHIVE, name=f"drive {number}", label=label))
        await ended(client, jobs[-1]["id"])

        async def pages(**query: Any) -> list[list[str]]:
            found: list[list[str]] = []
            url: str | None = str(httpx.URL("/v1/sequences", params=query))
            while url is not None:
                answer = await client.get(url)
                assert answer.status_code == 200, answer.text
                found.append([each["name"] for each in answer.json()])
                url = answer.links.get("next", {}).get("url")
            return found

        names = [f"drive {number}" for number in reversed(range(7))]
        assert await pages(page_size=3) == [names[:3], names[3:6], names[6:]]
        assert await pages(page_size=7) == [names]
        assert await pages(label="robot:r1", page_size=2) == [["drive 5", "drive 3"], ["drive 1"]]
        assert await pages(label=["robot:r1", "site:roof"]) == [[]]
        assert await pages(name="drive 4", state="done") == [["drive 4"]]
        assert await pages(state="failed") == [[]]
        assert await pages(created_after=jobs[4]["created"]) == [names[:2]] or (
            await pages(created_after=jobs[4]["created"]) == [names[:3]]
        )
        link = (await client.get("/v1/sequences", params={"page_size": 2})).links["next"]["url"]
        await client.delete(f"/v1/sequences/{jobs[5]['id']}")  # of the first page
        rest = [each["name"] for each in (await client.get(link)).json()]
        assert rest == names[2:4]


@pytest.mark.parametrize("token", ["nonsense", "MQ==", "other"])
async def test_a_page_token_of_another_list_is_refused(token: str, tmp_path: Path) -> None:
    async with as_ana(tmp_path) as client:
        for _ in range(2):
            await submit(client, ARCHIVE)
        if token == "other":
            answer = await client.get("/v1/sequences", params={"page_size": 1})
            token = str(httpx.URL(answer.links["next"]["url"]).params["page_token"])
            good = await client.get("/v1/sequences", params={"page_size": 1, "page_token": token})
            assert good.status_code == 200
        answer = await client.get("/v1/sequences", params={"state": "done", "page_token": token})
    assert (answer.status_code, reason_of(answer)) == (400, "BAD_SHAPE")
    assert "page_token" in answer.text


@pytest.mark.parametrize("label", ["hall", ":hall", "my site:hall", "site=hall"])
async def test_a_label_without_a_key_is_refused(label: str, tmp_path: Path) -> None:
    async with as_ana(tmp_path) as client:
        answer = await client.get("/v1/sequences", params={"label": label})
    assert (answer.status_code, reason_of(answer)) == (400, "BAD_SHAPE")


@pytest.mark.parametrize(
    "other",
    ["-29168", "1.5", "2.4e-105", "2026-01-31", "2026-01-31T12:00:00", "2026-01-31T12:00Z", "now"],
)
async def test_what_is_no_date_and_time_is_refused(other: str, tmp_path: Path) -> None:
    async with as_ana(tmp_path) as client:
        answer = await client.get("/v1/sequences", params={"created_after": other})
    assert answer.status_code == 400
    assert "expected a date and time" in answer.text
