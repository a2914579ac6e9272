"""The server as seen from the Zenoh network: keys, encodings, answers to foreign clients."""

import json
import stat
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh
from google.protobuf.message import Message
from google.protobuf.wrappers_pb2 import BytesValue
from google.rpc import status_pb2

from tests.support.certificates import Authority
from tests.support.frames import RIG, frame_message, make_frame, open_message
from tests.support.models import RecallModel
from tests.support.server import running_server
from tests.support.tokens import TokenFile
from tests.support.zenoh_net import address_of, free_endpoint
from tests.support.zenoh_sessions import step
from vergence import ConnectionLost, DepthClient
from vergence_proto.errors import BadShape, Quota, UnknownStream
from vergence_proto.v1 import depth_pb2 as pb
from vergence_proto.zenoh.inbox import Inbox
from vergence_proto.zenoh.keys import ANY, StreamKeys, query_key
from vergence_proto.zenoh.session import QueryReply, ZenohSession, make_config
from vergence_service.app.server import Running
from vergence_service.app.zenoh_command import zenoh_config
from vergence_service.transports.errors import ExtraMissing, ZenohUnreachable

NAMESPACE = "vergence"
MINE = "0123456789abcdef" * 2
KEYS = StreamKeys(NAMESPACE, MINE, "s")


class Client:
    """A client without the SDK, message by message."""

    def __init__(self, peer: ZenohSession) -> None:
        self.peer = peer
        self.inbox = Inbox(MINE, bulky=pb.DisparityMap, max_bulky=100, drop_oldest=False)

    async def ask(self, what: str, question: Message) -> QueryReply:
        key = query_key(NAMESPACE, "local", ANY, what)
        [answer] = await self.peer.query(key, question, timeout_s=5, attachment_id=MINE)
        return answer

    async def open(self, *, every: bool) -> None:
        for key in (KEYS.disparity, KEYS.status):
            await self.peer.subscribe(key, self.inbox.put)
        answer = await self.ask("open", open_message("s", every=every).open)
        assert answer.error is None

    async def send(self, message: Message, *, attachment_id: str = MINE) -> None:
        await self.peer.put(KEYS.frames, message, attachment_id=attachment_id)

    async def send_frame(self, frame_id: int, *, attachment_id: str = MINE) -> None:
        message = frame_message(make_frame(frame_id)).frame
        await self.send(message, attachment_id=attachment_id)


@asynccontextmanager
async def served(model: RecallModel | None = None, **flags: Any) -> AsyncIterator[Client]:
    endpoint = free_endpoint()
    config = make_config(max_message_bytes=1 << 24, mode="client", connect__endpoints=[endpoint])
    async with running_server(
        model or RecallModel(), zenoh__enabled=True, zenoh__listen=[endpoint], **flags
    ):
        peer = ZenohSession(config)
        await peer.open()
        try:
            yield Client(peer)
        finally:
            await peer.close()


async def test_messages_carry_their_type_and_the_quality_of_service_they_need() -> None:
    samples: list[zenoh.Sample] = []
    async with served() as client:
        await client.peer.subscribe(KEYS.disparity, samples.append)
        await client.open(every=False)
        await client.send_frame(1)
        answer = await client.inbox.take()
    [sample] = samples
    assert str(sample.encoding) == "application/protobuf;vergence.v1.DisparityMap"
    assert pb.DisparityMap.FromString(sample.payload.to_bytes()) == answer
    assert sample.priority == zenoh.Priority.REAL_TIME
    assert sample.congestion_control == zenoh.CongestionControl.DROP
    assert sample.express


async def test_a_lossless_answer_waits_on_the_way_instead_of_being_dropped() -> None:
    samples: list[zenoh.Sample] = []
    async with served() as client:
        await client.peer.subscribe(KEYS.disparity, samples.append)
        await client.open(every=True)
        await client.send_frame(1)
        await client.inbox.take()
    assert samples[0].congestion_control == zenoh.CongestionControl.BLOCK


async def test_queries_are_answered_by_messages_and_refused_by_errors_of_ours() -> None:
    async with served() as client:
        info = await client.ask("info", pb.GetServerInfoRequest())
        unknown = await client.ask("stream", pb.GetStreamRequest(stream_id="nobody"))
        verb = await client.ask("dance", pb.GetServerInfoRequest())
        opening = await client.ask("open", pb.OpenStream(stream_id="no rig"))
        garbage = await client.ask("open", BytesValue(value=b"\xff"))
        key = query_key(NAMESPACE, "local", ANY, "open")
        [nameless] = await client.peer.query(key, open_message("s").open, timeout_s=5)
    assert pb.GetServerInfoResponse.FromString(info.payload).model.name == "recall"
    assert isinstance(unknown.error, UnknownStream)
    assert isinstance(verb.error, BadShape)
    assert "open, info, stream, reset, close" in str(verb.error)
    assert opening.error is not None
    assert isinstance(garbage.error, BadShape)
    assert "attachment id" in str(nameless.error)


async def test_a_gap_in_the_ids_is_a_frame_that_the_network_lost() -> None:
    async with served() as client:
        await client.open(every=False)
        await client.send_frame(1)
        await client.inbox.take()
        await client.send_frame(3)
        lost, answer = await client.inbox.take(), await client.inbox.take()
    assert isinstance(lost, pb.StreamDepthResponse)
    assert list(lost.frames_dropped.frame_ids) == [2]
    assert isinstance(answer, pb.DisparityMap)
    assert (answer.frame_id, answer.frames_skipped) == (3, 1)


async def test_a_pong_says_which_frames_are_still_to_be_answered() -> None:
    model = RecallModel()
    async with served(model) as client:
        await client.open(every=True)
        with model.busy():
            await client.send_frame(1)
            await client.send(pb.Ping(client_ns=42))
            answer = await client.inbox.take()
    assert isinstance(answer, pb.StreamDepthResponse)
    assert answer.pong.client_ns == 42
    assert list(answer.pong.unanswered_frame_ids) == [1]


async def test_what_an_earlier_attachment_left_on_the_way_is_passed_over() -> None:
    async with served() as client:
        await client.open(every=True)
        await client.send_frame(1, attachment_id="before")
        await client.send_frame(2)
        answer = await client.inbox.take()
    assert isinstance(answer, pb.DisparityMap)
    assert answer.frame_id == 2


async def test_a_lossless_client_that_breaks_its_credit_is_ended() -> None:
    model = RecallModel()
    async with served(model, streams__credit=2, streams__waiting_frames=1) as client:
        await client.open(every=True)
        with model.busy():
            for frame_id in range(1, 41):
                await client.send_frame(frame_id)
        answered = []
        # A frame that the network lost is reported between the answers.
        while not isinstance(answer := await client.inbox.take(), status_pb2.Status):
            if isinstance(answer, pb.DisparityMap):
                answered.append(answer.frame_id)
    assert "credit" in answer.message
    assert answered == sorted(answered)
    assert len(answered) < 40


async def test_a_json5_file_says_where_to_listen(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    file = tmp_path / "zenoh.json5"
    file.write_text(
        f"{{mode: 'router', listen: {{endpoints: ['{endpoint}']}},"
        " scouting: {multicast: {enabled: false}}}"
    )
    config = make_config(max_message_bytes=1 << 20, mode="client", connect__endpoints=[endpoint])
    async with running_server(RecallModel(), zenoh__enabled=True, zenoh__config=file):
        peer = ZenohSession(config)
        await peer.open()
        key = query_key(NAMESPACE, "local", ANY, "info")
        assert len(await peer.query(key, pb.GetServerInfoRequest(), timeout_s=5)) == 1
        await peer.close()


async def test_who_may_come_in_is_for_the_file_to_say(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    users = tmp_path / "users.txt"
    users.write_text("headset:secret\n")
    file = tmp_path / "server.json5"
    file.write_text(
        f"{{mode: 'router', listen: {{endpoints: ['{endpoint}']}},"
        f" transport: {{auth: {{usrpwd: {{dictionary_file: '{users}'}}}}}}}}"
    )
    async with running_server(RecallModel(), zenoh__enabled=True, zenoh__config=file):
        for password, comes_in in (("secret", True), ("wrong", False)):
            user = tmp_path / f"{password}.json5"
            user.write_text(
                f"{{transport: {{auth: {{usrpwd: {{user: 'headset', password: '{password}'}}}}}}}}"
            )
            async with DepthClient(f"{address_of(endpoint)}?config={user}") as client:
                if comes_in:
                    assert (await client.server_info()).model.name == "recall"
                else:
                    with pytest.raises(ConnectionLost):
                        await client.server_info()


def test_the_router_that_we_recommend_is_one() -> None:
    file = Path(__file__).parents[2] / "docker" / "zenoh.json5"
    config = make_config(file, max_message_bytes=1 << 20)
    assert config.get_json("mode") == '"router"'


@asynccontextmanager
async def refused(**flags: Any) -> AsyncIterator[Running]:
    async with running_server(RecallModel(), zenoh__enabled=True, **flags) as server:
        yield server


async def test_what_an_operator_can_mend_is_reported_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    endpoint = free_endpoint()
    async with refused(zenoh__listen=[endpoint]):
        with pytest.raises(ZenohUnreachable, match=r"zenoh\.listen"):
            await refused(zenoh__listen=[endpoint]).__aenter__()
    with pytest.raises(ZenohUnreachable, match="cannot start Zenoh"):
        await refused(zenoh__mode="client", zenoh__connect=[free_endpoint()]).__aenter__()
    with pytest.raises(ZenohUnreachable, match="cannot start Zenoh"):
        await refused(zenoh__config=tmp_path / "missing.json5").__aenter__()
    monkeypatch.delitem(sys.modules, "vergence_service.transports.zenoh.server")
    monkeypatch.setitem(sys.modules, "zenoh", None)
    monkeypatch.delitem(sys.modules, "vergence_proto.zenoh.session")
    with pytest.raises(ExtraMissing, match=r"pip install 'vergence\[zenoh\]'"):
        await refused().__aenter__()


async def test_a_third_node_sees_nothing_and_cannot_answer(tmp_path: Path) -> None:
    """By default, where nobody has a name."""
    endpoint = free_endpoint()
    config = make_config(max_message_bytes=1 << 24, mode="client", connect__endpoints=[endpoint])
    spy = ZenohSession(config)
    async with (
        running_server(RecallModel(), zenoh__enabled=True, zenoh__listen=[endpoint]),
        spying(spy) as seen,
        DepthClient(address_of(endpoint)) as client,
        client.open_session(RIG) as session,
    ):
        await step(session, 1)
        assert (await client.stream_info(session.stream_id)).frames_stepped == 1
    assert seen == []


async def test_clients_whose_address_is_not_known_share_one_limit() -> None:
    endpoint = free_endpoint()
    async with (
        running_server(
            RecallModel(),
            zenoh__enabled=True,
            zenoh__listen=[endpoint],
            limits__streams_per_client=1,
        ),
        DepthClient(address_of(endpoint)) as one,
        DepthClient(address_of(endpoint)) as other,
        one.open_session(RIG),
    ):
        with pytest.raises(Quota, match="streams_per_client"):
            async with other.open_session(RIG, open_timeout_s=0.1):
                pass


async def test_each_user_has_its_own_keys(tmp_path: Path) -> None:
    file = TokenFile(tmp_path / "tokens.toml", "ana", "ben", "eve")
    endpoint = free_endpoint()
    zenoh_config(tmp_path, tokens=file.path, endpoint=endpoint)
    assert stat.S_IMODE((tmp_path / "users.txt").stat().st_mode) == 0o600

    def address(name: str) -> str:
        return f"{address_of(endpoint)}?config={tmp_path / name}.json5"

    spy = ZenohSession(
        make_config(
            tmp_path / "eve.json5",
            max_message_bytes=1 << 24,
            mode="client",
            connect__endpoints=[endpoint],
        )
    )
    guard: dict[str, Any] = {
        "security__tokens": file.path,
        "zenoh__enabled": True,
        "zenoh__config": tmp_path / "server.json5",
    }
    async with (
        running_server(RecallModel(), **guard) as server,
        spying(spy, "ana", "ben") as seen,
        DepthClient(address("ana")) as ana,
        DepthClient(address("ben")) as ben,
        ana.open_session(RIG, stream_id="headset") as hers,
        ben.open_session(RIG, stream_id="headset") as his,
    ):
        await step(hers, 1)
        await step(his, 1)
        assert sorted(each.key for each in server.engine.streams) == ["ana/headset", "ben/headset"]
        await ana.close_stream("headset")
        assert (await ben.stream_info("headset")).frames_stepped == 1
        assert seen == []
        # What the spy does itself, it may see. The server must not.
        keys = StreamKeys(NAMESPACE, "ben", "headset")
        await spy.put(keys.frames, frame_message(make_frame(2)).frame, attachment_id="x")
        await step(his, 3)
        assert (await ben.stream_info("headset")).frames_stepped == 2
        for name in ("ana", "ben", "local"):
            key = query_key(NAMESPACE, name, ANY, "stream")
            question = pb.GetStreamRequest(stream_id="headset")
            assert await spy.query(key, question, timeout_s=1) == []
        stranger = DepthClient(address_of(endpoint))  # without a password
        async with stranger:
            with pytest.raises(ConnectionLost):
                await stranger.server_info()


@asynccontextmanager
async def spying(spy: ZenohSession, *principals: str) -> AsyncIterator[list[str]]:
    """All that a node sees that asks for everything, and answers everything."""
    await spy.open()
    seen: list[str] = []
    known = [f"{NAMESPACE}/v1/@{name}" for name in (*principals, "local")]
    everything = ["**", f"{NAMESPACE}/**", f"{NAMESPACE}/v1/*/**", *(f"{key}/**" for key in known)]
    try:
        for key in (*everything, *(f"{key}/*/disparity" for key in known)):
            await spy.subscribe(key, lambda sample: seen.append(str(sample.key_expr)))
        for key in (*everything, *(f"{key}/@server/*/*" for key in known)):
            await spy.answer_queries(key, lambda query: seen.append(str(query.key_expr)))
        for key in ("**", *(f"{key}/*/@client/*" for key in known)):
            await spy.watch_liveliness(key, seen.append)
        yield seen
    finally:
        await spy.close()


async def test_a_stream_runs_over_quic(tmp_path: Path) -> None:
    authority = Authority(tmp_path)
    mine, endpoint = authority.issue("server"), free_endpoint().replace("tcp/", "quic/")
    certificate = {"listen_certificate": str(mine.cert), "listen_private_key": str(mine.key)}
    server_file, client_file = tmp_path / "server.json5", tmp_path / "client.json5"
    server_file.write_text(
        json.dumps(
            {
                "mode": "router",
                "listen": {"endpoints": [endpoint]},
                "transport": {"link": {"tls": certificate}},
            }
        )
    )
    trusted = {"root_ca_certificate": str(authority.ca)}
    client_file.write_text(json.dumps({"transport": {"link": {"tls": trusted}}}))
    address = f"zenoh+quic://{endpoint.removeprefix('quic/')}?config={client_file}"
    async with (
        running_server(RecallModel(), zenoh__enabled=True, zenoh__config=server_file),
        DepthClient(address) as client,
        client.open_session(RIG) as session,
    ):
        left, right = make_frame(1).left, make_frame(1).right
        assert (await session.step(left, right)).step_count == 1
