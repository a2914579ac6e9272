"""Webhooks: signed, sent until they arrive, and never to an address that is not allowed."""

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from tests.support.http import ZIP, ended, http_server, reason_of, submit
from tests.support.models import RecallModel
from tests.support.polling import eventually, eventually_true
from tests.support.sequences import make_frames, sequence_files, zip_bytes
from vergence_proto.errors import BadShape
from vergence_service.jobs.webhooks import WebhookHosts, signature_of

ARCHIVE = zip_bytes(sequence_files(make_frames(2)))


@dataclass
class Receiver:
    """The server of a client; it answers with these statuses, and then with 204."""

    statuses: list[int]
    url: str = ""
    received: list[tuple[dict[str, str], bytes]] = field(default_factory=list)
    changed: asyncio.Event = field(default_factory=asyncio.Event)

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = (await reader.readuntil(b"\r\n\r\n")).decode().split("\r\n")[1:-2]
        headers = {
            name.lower(): value for name, _, value in (line.partition(": ") for line in head)
        }
        body = await reader.readexactly(int(headers["content-length"]))
        self.received.append((headers, body))
        status = self.statuses.pop(0) if self.statuses else 204
        writer.write(f"HTTP/1.1 {status} x\r\nLocation: /elsewhere\r\n\r\n".encode())
        await writer.drain()
        writer.close()
        self.changed.set()


@asynccontextmanager
async def receiver(*statuses: int) -> AsyncIterator[Receiver]:
    receiving = Receiver(list(statuses))
    server = await asyncio.start_server(receiving.serve, "127.0.0.1", 0)
    receiving.url = f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}/hook?of=ours"
    async with server:
        yield receiving


async def test_jobs_that_end_together_are_signed_with_one_secret(tmp_path: Path) -> None:
    flags = {"batch__directory": tmp_path, "batch__webhook_hosts": ["127.0.0.1"]}
    async with receiver(*[500] * 50) as receiving:  # so all three are owed when a server starts
        async with http_server(RecallModel(), **flags) as client:
            for _ in range(3):
                await submit(client, ARCHIVE, webhook=receiving.url)
            await eventually(lambda: len(receiving.received) >= 3)
        (tmp_path / "webhook_secret").unlink()
        receiving.received.clear()
        async with http_server(RecallModel(), **flags):
            await eventually(lambda: len(receiving.received) >= 3)
    secret = (tmp_path / "webhook_secret").read_text()
    for headers, body in receiving.received:
        sent_s = int(headers["webhook-timestamp"])
        signature = signature_of(secret, headers["webhook-id"], sent_s, body)
        assert headers["webhook-signature"] == signature


async def test_a_webhook_is_signed_and_sent_until_it_arrives(tmp_path: Path) -> None:
    flags = {"batch__directory": tmp_path, "batch__webhook_hosts": ["127.0.0.1"]}
    async with receiver(500, 302) as receiving:
        async with http_server(RecallModel(), **flags) as client:
            job = await submit(client, ARCHIVE, webhook=receiving.url, name="drive 17")
            await receiving.changed.wait()
        receiving.changed.clear()
        async with http_server(RecallModel(), **flags) as client:  # it owes the message too

            async def arrived() -> bool:
                known = (await client.get(f"/v1/sequences/{job['id']}")).json()
                return bool(known["webhook_result"] == "delivered")

            await eventually_true(arrived)
    assert len(receiving.received) == 3
    secret = (tmp_path / "webhook_secret").read_text()
    for headers, body in receiving.received:
        assert headers["webhook-id"] == f"msg_{job['id']}"
        sent_s = int(headers["webhook-timestamp"])
        signature = signature_of(secret, headers["webhook-id"], sent_s, body)
        assert headers["webhook-signature"] == signature
        message = json.loads(body)
        assert message["type"] == "sequence.done"
        assert message["data"]["name"] == "drive 17"


async def test_who_is_gone_hears_no_more() -> None:
    flags = {"batch__webhook_hosts": ["127.0.0.1"]}
    async with receiver(410) as receiving, http_server(RecallModel(), **flags) as client:
        job = await submit(client, ARCHIVE, webhook=receiving.url)
        await ended(client, job["id"])

        async def given_up() -> bool:
            known = (await client.get(f"/v1/sequences/{job['id']}")).json()
            return bool(known["webhook_result"] == "given up")

        await eventually_true(given_up)
        assert len(receiving.received) == 1


@pytest.mark.parametrize(
    ("hosts", "webhook", "why"),
    [
        ([], "https://hooks.example.com/", "batch.webhook_hosts"),
        (["*"], "https://127.0.0.1/", "private address"),
        (["*"], "https://localhost:8443/", "private address"),
        (["*"], "https://10.1.2.3/", "private address"),
        (["*"], "https://169.254.169.254/latest", "private address"),
        (["*"], "https://[::1]/", "private address"),
        (["*"], "https://[::ffff:127.0.0.1]/", "private address"),
        (["*"], "http://93.184.215.14/", "https"),
        (["hooks.example.com"], "https://127.0.0.1/", "webhook_hosts allows"),
        (["127.0.0.1"], "https://ana:secret@127.0.0.1/", "https://HOST/PATH"),
        (["127.0.0.1"], "ftp://127.0.0.1/", "https://HOST/PATH"),
        (["127.0.0.1"], "https://127.0.0.1:99999/", "https://HOST/PATH"),
        (["127.0.0.1"], "https://127.0.0.1/a\r\nX: y", "https://HOST/PATH"),
    ],
)
async def test_a_webhook_goes_only_to_an_address_that_is_allowed(
    hosts: list[str], webhook: str, why: str
) -> None:
    with pytest.raises(BadShape, match=why):
        await WebhookHosts(hosts).target(webhook)


async def test_a_webhook_to_a_private_address_is_a_problem_of_the_submission() -> None:
    async with http_server(RecallModel(), batch__webhook_hosts=["*"]) as client:
        query = {"webhook": "https://169.254.169.254/latest"}
        answer = await client.post("/v1/sequences", params=query, content=ARCHIVE, headers=ZIP)
        assert reason_of(answer) == "BAD_SHAPE"
        assert "private address" in answer.json()["detail"]
