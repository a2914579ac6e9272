"""Servers behind one front, each with jobs of its own: any of them answers for all."""

import hashlib
import shutil
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.support.certificates import Authority
from tests.support.fleet import free_port
from tests.support.models import RecallModel
from tests.support.polling import eventually_true
from tests.support.redis_server import RedisServer, redis_server
from tests.support.sequences import make_frames, write_sequence
from tests.support.server import running_server
from tests.support.tokens import TokenFile
from vergence.jobs.client import AsyncBatchClient
from vergence_proto.errors import UnknownSequence
from vergence_service.app.server import Running
from vergence_service.settings import SettingsError

pytestmark = pytest.mark.slow  # it needs redis-server


class Servers:
    """Two servers, as clients with the tokens of ana and ben see them."""

    def __init__(self, a: Running, b: Running, store: RedisServer, tokens: dict[str, str]) -> None:
        self.a, self.b, self.store, self.tokens = a, b, store, tokens

    def of(self, server: Running, name: str = "ana") -> AsyncBatchClient:
        return AsyncBatchClient(f"http://{server.http_address}", token=self.tokens[name])

    def http(self, server: Running) -> httpx.AsyncClient:
        return httpx.AsyncClient(
            base_url=f"http://{server.http_address}",
            headers={"Authorization": f"Bearer {self.tokens['ana']}"},
        )


@asynccontextmanager
async def two_servers(
    folder: Path, model: RecallModel | None = None, **more: Any
) -> AsyncIterator[Servers]:
    tokens = TokenFile(folder / "tokens.toml", "ana", "ben")
    async with AsyncExitStack() as stack:
        store = stack.enter_context(redis_server())
        started = []
        for _ in range(2):
            flags = {"security__tokens": str(tokens.path), "batch__servers": store.url, **more}
            server = running_server(model or RecallModel(), **flags)
            started.append(await stack.enter_async_context(server))
        yield Servers(started[0], started[1], store, tokens.tokens)


@pytest.fixture
def room(tmp_path: Path) -> Path:
    return write_sequence(tmp_path / "room", make_frames(3))


@pytest.fixture
def zipped(tmp_path: Path, room: Path) -> bytes:
    return Path(shutil.make_archive(str(tmp_path / "archive"), "zip", room)).read_bytes()


async def test_a_job_of_one_server_is_followed_and_downloaded_at_the_other(
    tmp_path: Path, room: Path
) -> None:
    async with two_servers(tmp_path) as two, two.of(two.a) as here, two.of(two.b) as there:
        job = await here.submit(room)
        same = await there.job(job.id)
        watched = [info.frames_done async for info in same.watch()]
        assert watched[-1] == 3
        assert [frame.index async for frame in same.frames()] == [0, 1, 2]
        one, other = tmp_path / "one.zip", tmp_path / "other.zip"
        await job.download(one, "npz")
        await same.download(other, "npz")
        assert one.read_bytes() == other.read_bytes()
        async with two.of(two.b, "ben") as ben:
            with pytest.raises(UnknownSequence):
                await ben.job(job.id)
        await same.delete()
        with pytest.raises(UnknownSequence):
            await here.job(job.id)


async def test_parts_of_an_upload_and_its_submission_may_reach_either_server(
    tmp_path: Path, zipped: bytes
) -> None:
    half = len(zipped) // 2
    async with two_servers(tmp_path) as two, two.http(two.a) as a, two.http(two.b) as b:
        announced = await a.post("/v1/uploads", headers={"Upload-Length": str(len(zipped))})
        place = announced.headers["location"]
        for http, offset, part in ((b, 0, zipped[:half]), (a, half, zipped[half:])):
            answer = await http.patch(
                place,
                content=part,
                headers={
                    "Upload-Offset": str(offset),
                    "Content-Type": "application/offset+octet-stream",
                },
            )
            assert answer.status_code == 204, answer.text
        upload_id = place.rpartition("/")[2]
        submitted = await b.post(f"/v1/sequences?upload={upload_id}&wait=true&format=npz")
        assert submitted.status_code == 200, submitted.text
        assert two.a.engine.metrics.frames_stepped.labels("warm")._value.get() == 2  # noqa: SLF001


async def test_a_submission_that_is_repeated_at_the_other_server_is_accepted_once(
    tmp_path: Path, zipped: bytes
) -> None:
    headers = {"Idempotency-Key": '"once"', "Content-Type": "application/zip"}
    async with two_servers(tmp_path) as two, two.http(two.a) as a, two.http(two.b) as b:
        first = await a.post("/v1/sequences", content=zipped, headers=headers)
        again = await b.post("/v1/sequences", content=zipped, headers=headers)
        assert first.status_code == again.status_code == 202
        assert first.json()["id"] == again.json()["id"]
        rerun = await b.post(f"/v1/sequences/{first.json()['id']}/cancel")
        assert rerun.json()["id"] == first.json()["id"]


async def test_a_job_whose_server_is_gone_is_not_called_unknown(
    tmp_path: Path, zipped: bytes
) -> None:
    async with two_servers(tmp_path) as two, two.http(two.a) as a, two.http(two.b) as b:
        headers = {"Content-Type": "application/zip"}
        submitted = await a.post("/v1/sequences", content=zipped, headers=headers)
        assert submitted.status_code == 202
        place = submitted.headers["location"]
        name = hashlib.sha256(place.rpartition("/")[2].encode()).hexdigest()
        nowhere = f"http://127.0.0.1:{free_port()}"
        two.store.admin.set(f"vergence:job:{name}", nowhere)
        gone = await b.get(place)
        assert gone.status_code == 503
        assert gone.json()["reason"] == "NOT_READY"
        assert int(gone.headers["retry-after"]) > 0
        two.store.kill()
        blind = await b.get(place)
        assert (blind.status_code, blind.json()["reason"]) == (503, "NOT_READY")
        assert (await a.get(place)).status_code == 200  # its own server needs no directory


async def test_followers_that_leave_end_their_requests_at_the_other_server(
    tmp_path: Path, zipped: bytes
) -> None:
    model = RecallModel()
    async with (
        two_servers(tmp_path, model, limits__requests=2) as two,
        two.http(two.a) as a,
        two.http(two.b) as b,
    ):
        headers = {"Content-Type": "application/zip"}
        with model.busy():
            submitted = await a.post("/v1/sequences", content=zipped, headers=headers)
            place = submitted.headers["location"]
            for _ in range(5):  # more than may be open at once

                async def follows() -> bool:
                    async with b.stream("GET", f"{place}/events") as events:
                        return events.status_code == 200 and "progress" in await anext(
                            events.aiter_lines()
                        )

                await eventually_true(follows)


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ({"security__tls_cert": "CERT", "security__tls_key": "KEY"}, "a name of the certificate"),
        ({"server__host": "0.0.0.0", "security__insecure": True}, "other machines do not reach"),
    ],
    ids=["tls", "loopback"],
)
async def test_a_server_that_others_would_not_find_does_not_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flags: dict[str, Any], expected: str
) -> None:
    monkeypatch.setattr("socket.gethostbyname", lambda name: "127.0.1.1")  # as Debian has it
    issued = Authority(tmp_path).issue("front")
    files = {"CERT": str(issued.cert), "KEY": str(issued.key)}
    with pytest.raises(SettingsError, match=expected):
        async with two_servers(
            tmp_path, **{name: files.get(str(value), value) for name, value in flags.items()}
        ):
            pass
