"""Two servers behind Envoy, as docker/envoy.yaml has it: TLS in front, tokens for the servers."""

import asyncio
import ssl
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from tests.support.certificates import Authority
from tests.support.fleet import Envoy
from tests.support.frames import RIG
from tests.support.models import RecallModel
from tests.support.polling import eventually
from tests.support.redis_server import redis_server
from tests.support.sequences import make_frames, write_sequence
from tests.support.server import running_server
from tests.support.session_frames import EXACT, step
from tests.support.tokens import TokenFile
from vergence import Delivery, DepthClient, EventKind, SessionEvent
from vergence.jobs.client import AsyncBatchClient
from vergence_proto.errors import Unauthenticated
from vergence_service.app.server import Running, drain

pytestmark = pytest.mark.slow  # it needs Envoy and redis-server


class Front:
    def __init__(
        self, envoy: Envoy, servers: tuple[Running, Running], tokens: TokenFile, ca: Path
    ) -> None:
        self.envoy, self.servers, self.tokens, self.ca = envoy, servers, tokens, ca

    def client(self, token: str | None) -> DepthClient:
        return DepthClient(f"grpcs://{self.envoy.address}", token=token, ca=self.ca)

    def server_of(self, stream_id: str) -> Running:
        [server] = [
            each
            for each in self.servers
            if any(
                stream.stream_id == stream_id and stream.attachment is not None
                for stream in each.engine.streams
            )
        ]
        return server


@asynccontextmanager
async def front(folder: Path) -> AsyncIterator[Front]:
    authority = Authority(folder)
    envoy = Envoy(folder, certificate=authority.issue("front"))
    tokens = TokenFile(folder / "tokens.toml", "ana", "ben")
    flags: dict[str, Any] = {"security__tokens": str(tokens.path), "server__drain_s": 0.5}
    flags["limits__streams"] = 16
    with redis_server() as store:
        flags["snapshots__store"] = flags["batch__servers"] = store.url
        async with (
            running_server(RecallModel(), **flags) as a,
            running_server(RecallModel(), **flags) as b,
        ):
            envoy.lead_to([(each.grpc_address, each.http_address) for each in (a, b)])
            try:
                await envoy.start(authority.ca.read_bytes())
                yield Front(envoy, (a, b), tokens, authority.ca)
            finally:
                envoy.stop()


async def test_streams_of_a_draining_server_go_on_at_the_other_one(tmp_path: Path) -> None:
    events: list[SessionEvent] = []
    async with (
        front(tmp_path) as two,
        two.client(two.tokens.tokens["ana"]) as ana,
        two.client("vrg_guessed") as stranger,
        ana.open_session(
            RIG,
            delivery=Delivery.EVERY,
            output=EXACT,
            stream_id="mine",
            on_event=events.append,
        ) as session,
    ):
        with pytest.raises(Unauthenticated):
            async with stranger.open_session(RIG):
                pass
        results = [await step(session, frame_id) for frame_id in (1, 2, 3)]
        first = two.server_of("mine")
        # The question finds the stream's own server.
        assert (await ana.stream_info("mine")).last_frame_id == 3
        await drain(first, within_s=0.5)
        await eventually(lambda: EventKind.RESUMED in [event.kind for event in events])
        results += [await step(session, frame_id) for frame_id in (4, 5)]
        assert two.server_of("mine") is not first
        async with httpx.AsyncClient(
            verify=ssl.create_default_context(cafile=two.ca),
            base_url=f"https://{two.envoy.http_address}",
        ) as http:
            assert (await http.get("/readyz")).status_code == 200
    assert [result.step_count for result in results] == [1, 2, 3, 4, 5]
    async with (
        running_server(RecallModel()) as quiet,
        DepthClient(quiet.grpc_address) as client,
        client.open_session(RIG, delivery=Delivery.EVERY, output=EXACT) as session,
    ):
        for frame_id, result in enumerate(results, start=1):
            same = await step(session, frame_id)
            np.testing.assert_array_equal(result.disparity_px, same.disparity_px)


async def test_a_stream_keeps_its_server_when_it_connects_again(tmp_path: Path) -> None:
    async with front(tmp_path) as two, two.client(two.tokens.tokens["ben"]) as ben:
        for number in range(8):
            stream_id = f"camera-{number}"
            async with ben.open_session(RIG, stream_id=stream_id) as session:
                await step(session, 1)
                server, token = two.server_of(stream_id), session.resume_token
                async with ben.open_session(RIG, stream_id=stream_id, resume_token=token) as again:
                    await asyncio.wait_for(step(again, 2), 20)
                    assert two.server_of(stream_id) is server


async def test_no_server_gets_many_more_streams_than_another(tmp_path: Path) -> None:
    async with front(tmp_path) as two, two.client(two.tokens.tokens["ana"]) as ana:
        at_one: list[str] = []  # ids that lead to the first server while there is room
        for number in range(100):
            async with ana.open_session(RIG, stream_id=f"camera-{number}") as session:
                if two.server_of(session.stream_id) is two.servers[0]:
                    at_one.append(session.stream_id)
            if len(at_one) == 12:
                break
        async with AsyncExitStack() as sessions:
            for stream_id in at_one:
                await sessions.enter_async_context(ana.open_session(RIG, stream_id=stream_id))
            counts = [len(list(each.engine.streams)) for each in two.servers]
        assert sum(counts) == 12
        assert counts[0] <= 9  # 1.25 times the mean, and one: Envoy looks before it adds


async def test_streams_and_jobs_over_http_find_their_server(tmp_path: Path) -> None:
    room = write_sequence(tmp_path / "room", make_frames(3))
    async with front(tmp_path) as two:
        token, address = two.tokens.tokens["ana"], f"https://{two.envoy.http_address}"
        async with (
            DepthClient(address, token=token, ca=two.ca) as ana,
            ana.open_session(RIG, delivery=Delivery.EVERY, output=EXACT) as session,
        ):
            counts = [(await step(session, frame_id)).step_count for frame_id in (1, 2, 3)]
        assert counts == [1, 2, 3]
        for _ in range(4):  # by chance, one request may reach the right server
            async with AsyncBatchClient(address, token=token, ca=two.ca) as client:
                job = await client.submit(room)
                frames = [each async for each in job.frames()]
                assert len(frames) == 3
            # One that has no cookie of Envoy, as a program that is started again.
            async with AsyncBatchClient(address, token=token, ca=two.ca) as another:
                assert (await (await another.job(job.id)).wait()).frames_done == 3
