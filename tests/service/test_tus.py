"""An upload that breaks off goes on where it broke off."""

import asyncio
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from tests.support.http import disparities, ended, http_server, http_to, reason_of, submit
from tests.support.models import RecallModel
from tests.support.polling import eventually
from tests.support.sequences import make_frames, sequence_files, write_sequence, zip_bytes
from tests.support.server import running_server
from tests.support.tokens import TokenFile, http_as
from vergence import AsyncBatchClient
from vergence.jobs.packing import find_upload

ARCHIVE = zip_bytes(sequence_files(make_frames(3)))
PART = {"Tus-Resumable": "1.0.0", "Content-Type": "application/offset+octet-stream"}


async def announced(client: httpx.AsyncClient, length: int = len(ARCHIVE)) -> str:
    answer = await client.post("/v1/uploads", headers={"Upload-Length": str(length)})
    assert (answer.status_code, answer.headers["Tus-Resumable"]) == (201, "1.0.0")
    return str(answer.headers["Location"])


async def send(client: httpx.AsyncClient, url: str, offset: int, body: bytes) -> httpx.Response:
    return await client.patch(url, content=body, headers={**PART, "Upload-Offset": str(offset)})


async def test_parts_become_the_job_that_the_whole_would_be(tmp_path: Path) -> None:
    flags: dict[str, Any] = {"batch__directory": tmp_path}
    async with http_server(RecallModel(), **flags) as client:
        url = await announced(client)
        assert (await send(client, url, 0, ARCHIVE[:1000])).headers["Upload-Offset"] == "1000"
        early = await client.post("/v1/sequences", params={"upload": url.rpartition("/")[2]})
        assert (early.status_code, reason_of(early)) == (400, "BAD_SEQUENCE")
        assert f"1000 of {len(ARCHIVE)}" in early.text
    async with http_server(RecallModel(), **flags) as client:  # the server was restarted
        state = await client.head(url)
        assert state.headers["Upload-Offset"] == "1000"
        assert state.headers["Upload-Length"] == str(len(ARCHIVE))
        assert "Upload-Expires" in state.headers
        assert (await send(client, url, 1000, ARCHIVE[1000:])).status_code == 204
        query = {"upload": url.rpartition("/")[2]}
        key = {"Idempotency-Key": '"k"'}
        job = (await client.post("/v1/sequences", params=query, headers=key)).json()
        again = await client.post("/v1/sequences", params=query, headers=key)
        assert again.json()["id"] == job["id"]
        await ended(client, job["id"])
        whole = await submit(client, ARCHIVE)
        await ended(client, whole["id"])
        np.testing.assert_array_equal(
            await disparities(client, job["id"]), await disparities(client, whole["id"])
        )
        assert (await client.head(url)).status_code == 404  # it is the job's now
    assert not list((tmp_path / "uploads").iterdir())


async def test_wrong_requests_are_refused_and_change_nothing() -> None:
    async with http_server(RecallModel(), batch__max_upload_mib=1) as client:
        url = await announced(client)
        await send(client, url, 0, ARCHIVE[:100])
        json = {**PART, "Content-Type": "application/json", "Upload-Offset": "100"}
        old = {**PART, "Tus-Resumable": "0.2.0", "Upload-Offset": "100"}
        for answer, status in (
            (await send(client, url, 99, b"x"), 409),
            (await client.patch(url, content=b"x", headers=json), 415),
            (await client.patch(url, content=b"x", headers=old), 412),
            (await client.patch(url, content=b"x", headers=PART), 400),
            (await send(client, "/v1/uploads/nothing", 0, b"x"), 404),
            (await send(client, "/v1/uploads/..", 0, b"x"), 404),
            (await client.post("/v1/uploads", headers={"Upload-Length": str(2 << 20)}), 413),
            (await client.post("/v1/uploads"), 400),
            (await send(client, url, 100, ARCHIVE), 400),
        ):
            assert answer.status_code == status, answer.text
            assert answer.headers["Content-Type"] == "application/problem+json"
        assert int((await client.head(url)).headers["Upload-Offset"]) <= len(ARCHIVE)
        options = await client.options("/v1/uploads")
        assert options.headers["Tus-Max-Size"] == str(1 << 20)
        assert (await client.delete(url)).status_code == 204
        assert (await client.head(url)).status_code == 404


async def test_the_upload_of_another_is_unknown(tmp_path: Path) -> None:
    file = TokenFile(tmp_path / "tokens.toml", "ana", "ben")
    async with (
        running_server(RecallModel(), security__tokens=file.path) as server,
        http_as(server, file.shown("ana")) as ana,
        http_as(server, file.shown("ben")) as ben,
    ):
        url = await announced(ana)
        await send(ana, url, 0, ARCHIVE)
        assert (await ben.head(url)).status_code == 404
        answer = await ben.post("/v1/sequences", params={"upload": url.rpartition("/")[2]})
        assert (answer.status_code, reason_of(answer)) == (404, "SEQUENCE_UNKNOWN")
        assert (await ana.head(url)).status_code == 200


async def test_a_request_that_hangs_is_replaced_by_the_next(tmp_path: Path) -> None:
    async with (
        running_server(RecallModel(), batch__directory=tmp_path) as server,
        http_to(server) as client,
    ):
        url = await announced(client)
        _, writer = await asyncio.open_connection(*server.http_address.split(":"))
        head = (
            f"PATCH {url} HTTP/1.1\r\nHost: {server.http_address}\r\nUpload-Offset: 0\r\n"
            f"Content-Type: {PART['Content-Type']}\r\nContent-Length: {len(ARCHIVE)}\r\n\r\n"
        )
        try:
            writer.write(head.encode() + ARCHIVE[:500])
            await writer.drain()
            body = tmp_path / "uploads" / url.rpartition("/")[2] / "body"
            await eventually(lambda: body.stat().st_size == 500)
            assert (await client.head(url)).headers["Upload-Offset"] == "500"
            assert (await send(client, url, 500, ARCHIVE[500:])).status_code == 204
        finally:
            writer.close()


class CuttingProxy:
    """Passes so many bytes up or down on each connection, and then breaks it."""

    def __init__(self, target: str, most: int) -> None:
        self._host, _, port = target.rpartition(":")
        self._port = int(port)
        self._most = most
        self.up = self.down = self.cuts = 0

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        there, back = await asyncio.open_connection(self._host, self._port)

        async def pump(
            source: asyncio.StreamReader, sink: asyncio.StreamWriter, direction: str
        ) -> None:
            left = self._most
            while left and (data := await source.read(min(left, 4096))):
                left -= len(data)
                setattr(self, direction, getattr(self, direction) + len(data))
                sink.write(data)
                await sink.drain()
            self.cuts += not left

        pumps = [
            asyncio.create_task(pump(reader, back, "up")),
            asyncio.create_task(pump(there, writer, "down")),
        ]
        with suppress(OSError):
            await asyncio.wait(pumps, return_when=asyncio.FIRST_COMPLETED)
        for each in pumps:
            each.cancel()
        await asyncio.gather(*pumps, return_exceptions=True)
        for end in (back, writer):
            end.close()
            with suppress(OSError):
                await end.wait_closed()


@pytest.mark.slow
async def test_a_transfer_that_is_cut_again_and_again_sends_only_the_cut_parts_twice(
    tmp_path: Path,
) -> None:
    folder = write_sequence(tmp_path / "room", make_frames(12))
    size = find_upload(folder).size()
    most = size // 4
    async with running_server(RecallModel()) as server:
        proxy = CuttingProxy(server.http_address, most)
        listening = await asyncio.start_server(proxy.serve, "127.0.0.1", 0)
        host, port = listening.sockets[0].getsockname()[:2]
        async with listening, AsyncBatchClient(f"{host}:{port}") as client:
            job = await client.submit(folder, outputs=["sigma", "left"])
            up, cuts = proxy.up, proxy.cuts
            frames = [frame async for frame in job.frames()]
            kept = job.info.frames
            down, cuts_down = proxy.down, proxy.cuts
            archive = await job.download(tmp_path / "cut.zip", "npz")
            down, cuts_down = proxy.down - down, proxy.cuts - cuts_down
        async with AsyncBatchClient(server.http_address) as client:
            direct = await client.job(job.id)
            whole = [each async for each in direct.frames()]
            expected_archive = await direct.download(tmp_path / "whole.zip", "npz")
    assert kept == len(frames) == 12
    assert cuts >= 3
    # Headers, and what was on its way when a line was cut.
    assert up < size + 12_000 * (cuts + 3)
    assert cuts_down >= 3
    assert archive.read_bytes() == expected_archive.read_bytes()
    assert down < archive.stat().st_size + 6_000 * (cuts_down + 1)
    for frame, expected in zip(frames, whole, strict=True):
        assert frame.disparity_px is not None
        np.testing.assert_array_equal(frame.disparity_px, expected.disparity_px)


@pytest.mark.parametrize("name", ["a", "../jobs", "%2e%2e"])
async def test_an_upload_that_is_none_is_no_job(name: str) -> None:
    async with http_server(RecallModel()) as client:
        answer = await client.post("/v1/sequences", params={"upload": name})
        assert (answer.status_code, reason_of(answer)) == (404, "SEQUENCE_UNKNOWN")
