"""Who may do what: tokens, owners, certificates, web pages and addresses."""

import asyncio
import logging
import ssl
import stat
import subprocess
import sys
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grpc
import httpx
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc

from tests.support.certificates import Authority
from tests.support.frames import RIG, frame_message, make_frame, open_message
from tests.support.http import PROTOBUF, ZIP, ended, http_to, reason_of, submit
from tests.support.models import RecallModel
from tests.support.polling import eventually, eventually_true
from tests.support.sequences import make_frames, sequence_files, zip_bytes
from tests.support.server import RawCall, raw_stream, running_server
from tests.support.status import reason_of as reason_over_grpc
from tests.support.tokens import TokenFile, http_as, stub
from vergence import (
    BlockingClient,
    DepthClient,
    Pose,
    Unauthenticated,
    UnknownStream,
)
from vergence_proto.capabilities import Capability
from vergence_proto.v1 import depth_pb2 as pb
from vergence_service.access.principals import LOCAL
from vergence_service.app.security import check_exposure
from vergence_service.app.server import Running
from vergence_service.settings import SettingsError, load_settings

ARCHIVE = zip_bytes(sequence_files(make_frames(2)))


@dataclass
class Guarded:
    """A server that asks for tokens."""

    server: Running
    file: TokenFile
    jobs: Path

    def http(self, name: str) -> Any:
        return http_as(self.server, self.file.shown(name))

    def client(self, name: str, scheme: str = "grpc") -> DepthClient:
        address = self.server.http_address if scheme == "http" else self.server.grpc_address
        return DepthClient(f"{scheme}://{address}", token=self.file.tokens[name])


@pytest.fixture
async def guarded(tmp_path: Path) -> AsyncIterator[Guarded]:
    folder = tmp_path / "guarded"
    file = TokenFile(folder / "tokens.toml", "ana", "ben", "gone", admins=("root",))
    async with running_server(
        RecallModel(), security__tokens=file.path, batch__directory=folder / "jobs"
    ) as server:
        yield Guarded(server, file, folder / "jobs")


METHODS: list[tuple[str, Callable[..., Any]]] = [
    ("GetStream", pb.GetStreamRequest),
    ("ResetStream", pb.ResetStreamRequest),
    ("CloseStream", pb.CloseStreamRequest),
]


@pytest.mark.parametrize("scheme", ["grpc", "http"])
async def test_the_stream_of_another_is_unknown(guarded: Guarded, scheme: str) -> None:
    async with (
        guarded.client("ana", scheme) as ana,
        guarded.client("ben", scheme) as ben,
        ana.open_session(RIG, stream_id="headset-1") as mine,
        ben.open_session(RIG, stream_id="headset-1") as theirs,
        guarded.http("ben") as http,
        stub(guarded.server) as calls,
    ):
        await ana.close_stream("headset-1")
        assert (await ben.stream_info("headset-1")).stream_id == "headset-1"
        as_ben = tuple(guarded.file.shown("ben").items())
        async with ana.open_session(RIG, stream_id="only-mine") as only_mine:
            for name, question in METHODS:
                ask = question(stream_id="only-mine", resume_token=only_mine.resume_token)
                with pytest.raises(grpc.aio.AioRpcError) as refusal:
                    await getattr(calls, name)(ask, metadata=as_ben)
                assert reason_over_grpc(refusal.value) == "STREAM_UNKNOWN"
                answer = await http.post(
                    f"/v1/methods/{name}", content=ask.SerializeToString(), headers=PROTOBUF
                )
                assert reason_of(answer) == "STREAM_UNKNOWN"
            # The secret of a stream is of no use to another principal either.
            with pytest.raises(UnknownStream):
                async with ben.open_session(
                    RIG, stream_id="only-mine", resume_token=only_mine.resume_token, on_lost="raise"
                ):
                    pass
            assert (await ana.stream_info("only-mine")).attached
        del mine, theirs


async def test_without_tokens_a_stream_obeys_only_those_who_know_its_secret() -> None:
    async with (
        running_server(RecallModel()) as server,
        raw_stream(server, "headset-1") as call,
        stub(server) as calls,
        DepthClient(f"grpc://{server.grpc_address}") as stranger,
    ):
        for name, question in METHODS:
            for secret in (b"", b"guessed", call.opened.resume_token[:-1]):
                with pytest.raises(grpc.aio.AioRpcError) as refusal:
                    await getattr(calls, name)(question(stream_id="headset-1", resume_token=secret))
                assert reason_over_grpc(refusal.value) == "STREAM_UNKNOWN"
        with pytest.raises(UnknownStream):
            await stranger.close_stream("headset-1")
        assert (await call.ask(frame_message(make_frame(1)))).HasField("disparity")
        for name, question in METHODS:
            await getattr(calls, name)(
                question(stream_id="headset-1", resume_token=call.opened.resume_token)
            )
    assert server.engine.streams.attachments() == []


async def test_an_administrator_sees_and_ends_the_streams_of_all(guarded: Guarded) -> None:
    async with (
        guarded.client("ana") as ana,
        ana.open_session(RIG, stream_id="seen"),
        guarded.client("root") as root,
    ):
        as_root = tuple(guarded.file.shown("root").items())
        as_ben = tuple(guarded.file.shown("ben").items())
        question = pb.CloseStreamRequest(stream_id="ana/seen")
        async with stub(guarded.server) as calls:
            with pytest.raises(grpc.aio.AioRpcError) as refusal:
                await calls.CloseStream(question, metadata=as_ben)
            assert reason_over_grpc(refusal.value) == "STREAM_UNKNOWN"
            await calls.CloseStream(question, metadata=as_root)
        with pytest.raises(UnknownStream):
            await ana.stream_info("seen")
        assert (await root.server_info()).streams_open == 0


async def test_the_job_of_another_is_unknown(guarded: Guarded) -> None:
    async with guarded.http("ana") as ana, guarded.http("ben") as ben, guarded.http("root") as root:
        job_id = (await submit(ana, ARCHIVE))["id"]
        await ended(ana, job_id)
        for method, path in (
            ("GET", ""),
            ("GET", "/events"),
            ("GET", "/result"),
            ("DELETE", ""),
        ):
            answer = await ben.request(method, f"/v1/sequences/{job_id}{path}")
            assert (answer.status_code, reason_of(answer)) == (404, "SEQUENCE_UNKNOWN")
        listed = {
            name: [each["id"] for each in (await http.get("/v1/sequences")).json()]
            for name, http in (("ana", ana), ("ben", ben), ("root", root))
        }
        assert listed == {"ana": [job_id], "ben": [], "root": [job_id]}
        assert (await root.get(f"/v1/sequences/{job_id}/result")).status_code == 200
        assert (await ana.delete(f"/v1/sequences/{job_id}")).status_code == 204


async def test_without_tokens_nobody_lists_jobs_and_their_ids_are_secrets(tmp_path: Path) -> None:
    async with (
        running_server(RecallModel(), batch__directory=tmp_path) as server,
        http_to(server) as http,
    ):
        job = await submit(http, ARCHIVE)
        await ended(http, job["id"])
        assert len(job["id"]) >= 32
        assert (await http.get("/v1/sequences")).json() == []
        assert (await http.get(f"/v1/sequences/{job['id']}/result")).status_code == 200
        paths = [tmp_path, tmp_path / "jobs", tmp_path / "incoming", tmp_path / "jobs.sqlite3"]
        assert not any(stat.S_IMODE(path.stat().st_mode) & 0o077 for path in paths)


async def test_without_a_valid_token_nothing_but_the_health_answers(
    guarded: Guarded, caplog: pytest.LogCaptureFixture
) -> None:
    for shown in ({}, guarded.file.shown("nobody"), {"authorization": "Basic YW5hOnB3"}):
        async with http_as(guarded.server, dict(shown)) as http:
            for path in ("/v1/sequences", "/openapi.json", "/nothing"):
                answer = await http.get(path)
                assert (answer.status_code, reason_of(answer)) == (401, "UNAUTHENTICATED")
                assert answer.headers["www-authenticate"] == "Bearer"
            answer = await http.post("/v1/sequences", content=ARCHIVE, headers=ZIP)
            assert answer.status_code == 401
            assert (await http.get("/readyz")).status_code == 200
        async with stub(guarded.server) as calls:
            call = RawCall(calls.StreamDepth(metadata=tuple(dict(shown).items())))
            with pytest.raises(grpc.aio.AioRpcError) as refusal:
                await call.ask(open_message())
            assert refusal.value.code() is grpc.StatusCode.UNAUTHENTICATED
    async with grpc.aio.insecure_channel(guarded.server.grpc_address) as channel:
        health = await health_pb2_grpc.HealthStub(channel).Check(health_pb2.HealthCheckRequest())
    assert health.status == health_pb2.HealthCheckResponse.SERVING
    assert not [record for record in caplog.records if record.levelno >= logging.ERROR]
    assert not any(token in caplog.text for token in guarded.file.tokens.values())


async def test_a_principal_that_has_its_share_leaves_room_to_others(guarded: Guarded) -> None:
    as_ana, as_ben = (tuple(guarded.file.shown(name).items()) for name in ("ana", "ben"))
    async with stub(guarded.server) as calls:
        kept = []
        for _ in range(4):
            kept.append(RawCall(calls.StreamDepth(metadata=as_ana)))
            await kept[-1].ask(open_message())
        with pytest.raises(grpc.aio.AioRpcError) as refusal:
            await RawCall(calls.StreamDepth(metadata=as_ana)).ask(open_message())
        assert reason_over_grpc(refusal.value) == "QUOTA"
        assert "close one" in (refusal.value.details() or "")
        dear = open_message()
        dear.open.cold_iterations = 64
        with pytest.raises(grpc.aio.AioRpcError) as refusal:
            await RawCall(calls.StreamDepth(metadata=as_ben)).ask(dear)
        assert reason_over_grpc(refusal.value) == "QUOTA"
        assert "limits.iterations" in (refusal.value.details() or "")
        kept.append(RawCall(calls.StreamDepth(metadata=as_ben)))
        await kept[-1].ask(open_message())
        for call in kept:
            call.call.cancel()
    await eventually(lambda: not guarded.server.engine.streams.attachments())
    guarded.server.engine.streams.end_those_of(lambda owner: owner != LOCAL)


async def test_removing_a_token_ends_its_streams(guarded: Guarded) -> None:
    as_gone, as_ana = (tuple(guarded.file.shown(name).items()) for name in ("gone", "ana"))
    async with stub(guarded.server) as calls:
        theirs = RawCall(calls.StreamDepth(metadata=as_gone))
        await theirs.ask(open_message("theirs"))
        mine = RawCall(calls.StreamDepth(metadata=as_ana))
        await mine.ask(open_message("mine"))
        del guarded.file.tokens["gone"]
        guarded.file.write()
        with pytest.raises(grpc.aio.AioRpcError) as end:
            await theirs.receive()
        assert reason_over_grpc(end.value) == "UNAUTHENTICATED"
        assert (await mine.ask(frame_message(make_frame(1)))).HasField("disparity")
        with pytest.raises(grpc.aio.AioRpcError) as refusal:
            await calls.GetServerInfo(pb.GetServerInfoRequest(), metadata=as_gone)
        assert refusal.value.code() is grpc.StatusCode.UNAUTHENTICATED
        # A file with errors changes nothing.
        guarded.file.path.write_text("[oops")
        await asyncio.sleep(0)
        await calls.GetServerInfo(pb.GetServerInfoRequest(), metadata=as_ana)
        guarded.file.write()
        mine.call.cancel()


async def test_a_web_page_gets_nothing() -> None:
    body = pb.GetServerInfoRequest().SerializeToString()
    ask: tuple[str, str, bytes] = ("POST", "/v1/methods/GetServerInfo", body)
    async with running_server(RecallModel(), security__hosts=["depth.example"]) as server:
        own = server.http_address

        async def status(*request: Any, **headers: str) -> int:
            method, path, content = request
            named = {key.replace("_", "-"): value for key, value in headers.items()}
            async with http_to(server) as http:
                answer = await http.request(method, path, content=content, headers=named)
            assert not [name for name in answer.headers if name.startswith("access-control")]
            assert answer.headers["x-content-type-options"] == "nosniff"
            return answer.status_code

        good = {"content_type": "application/x-protobuf"}
        assert await status(*ask, **good) == 200
        for host in ("localhost:1", "[::1]:80", "depth.example", "a.localhost", "10.0.0.1"):
            assert await status(*ask, **good, host=host) == 200
        mine = {"origin": f"http://{own}", "sec_fetch_site": "same-origin"}
        assert await status(*ask, **good, **mine) == 200
        for foreign in ("evil.example", "127.0.0.1.evil.example", "localhost.evil.example:80", "x"):
            assert await status("GET", "/v1/sequences", b"", host=foreign) == 403
            assert await status("GET", "/nothing", b"", host=foreign) == 403
        for page in ("https://evil.example", "null", "http://localhost:3000", f"http://{own}0"):
            assert await status(*ask, **good, origin=page) == 403
            assert await status("OPTIONS", "/v1/pairs", b"", origin=page) == 403
        for site in ("cross-site", "same-site"):
            assert await status("POST", "/v1/sequences", ARCHIVE, sec_fetch_site=site) == 403
        for kind in ("text/plain", "application/json", "multipart/form-data; boundary=x"):
            assert await status(*ask, content_type=kind) == 400
        async with http_to(server) as http:
            request = http.build_request(*ask[:2], content=body)
            assert (await http.send(request)).status_code == 400  # without any content type


def settings_of(**flags: Any) -> Any:
    return load_settings(flags={key.replace("__", "."): each for key, each in flags.items()})


TLS = {"security__tls_cert": "c", "security__tls_key": "k"}
ANYWHERE = {"server__host": "0.0.0.0"}


@pytest.mark.parametrize(
    ("flags", "starts"),
    [
        ({}, True),
        ({"server__host": "::1"}, True),
        ({"server__host": "localhost", "security__tokens": "t"}, True),
        (ANYWHERE, False),
        ({"grpc__host": "192.168.1.2"}, False),
        ({"http__host": "::"}, False),
        ({**ANYWHERE, "security__tokens": "t"}, False),
        ({**ANYWHERE, **TLS}, False),
        ({**ANYWHERE, **TLS, "security__tokens": "t"}, True),
        ({**ANYWHERE, **TLS, "security__client_ca": "a"}, True),
        ({**ANYWHERE, "security__insecure": True}, True),
        ({"zenoh__enabled": True}, True),
        ({"zenoh__enabled": True, "zenoh__host": "0.0.0.0"}, False),
        ({"zenoh__enabled": True, "zenoh__listen": ["tcp/[::]:7447"]}, False),
        ({"security__tls_cert": "c"}, False),
        ({"security__client_ca": "a"}, False),
    ],
)
def test_what_strangers_could_reach_does_not_start(flags: dict[str, Any], starts: bool) -> None:
    settings = settings_of(**flags)
    if starts:
        check_exposure(settings)
    else:
        with pytest.raises(SettingsError, match=r"--insecure|security\.tls_"):
            check_exposure(settings)


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    return Authority(tmp_path_factory.mktemp("authority"))


@pytest.mark.parametrize("scheme", ["grpcs", "https"])
async def test_over_tls_with_a_token(authority: Authority, tmp_path: Path, scheme: str) -> None:
    issued = authority.issue(scheme)
    file = TokenFile(tmp_path / "tokens", "ana")
    guard: dict[str, Any] = {
        "security__tls_cert": issued.cert,
        "security__tls_key": issued.key,
        "security__tokens": file.path,
    }
    async with running_server(RecallModel(), **guard) as server:
        place = server.grpc_address if scheme == "grpcs" else server.http_address
        address = f"{scheme}://{place}"
        frame = make_frame(1)
        token = file.tokens["ana"]
        async with (
            DepthClient(address, token=token, ca=authority.ca) as client,
            client.open_session(RIG) as session,
        ):
            assert token not in repr(client) + repr(session) + repr(vars(client))
            result = await session.step(frame.left, frame.right, Pose.identity())
            assert result.frame_id == 1
        async with DepthClient(address, token="vrg_wrong", ca=authority.ca) as stranger:
            with pytest.raises(Unauthenticated):
                await stranger.server_info()
        serial = await serial_at(place)
        authority.issue(scheme)  # in place of the old files

        async def is_new() -> bool:
            return await serial_at(place) != serial

        await eventually_true(is_new)
        async with DepthClient(address, token=token, ca=authority.ca) as client:
            assert (await client.server_info()).streams_open == 0


async def serial_at(place: str) -> bytes:
    host, _, port = place.rpartition(":")
    return (await asyncio.to_thread(ssl.get_server_certificate, (host, int(port)))).encode()


async def test_a_clients_certificate_names_its_principal(authority: Authority) -> None:
    own, theirs = authority.issue("server"), authority.issue("ana", subject="ana")
    guard: dict[str, Any] = {
        "security__tls_cert": own.cert,
        "security__tls_key": own.key,
        "security__client_ca": authority.ca,
    }
    async with running_server(RecallModel(), **guard) as server:
        for address in (f"grpcs://{server.grpc_address}", f"https://{server.http_address}"):
            async with (
                DepthClient(address, ca=authority.ca, cert=theirs.cert, key=theirs.key) as client,
                client.open_session(RIG, stream_id="a"),
            ):
                assert [each.owner.name for each in server.engine.streams] == ["ana"]


def test_a_token_is_not_sent_in_the_clear(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="grpcs://"):
        DepthClient("grpc://depth.example:50051", token="vrg_secret")
    with pytest.raises(ValueError, match="https://"):
        BlockingClient("http://depth.example:8000", token="vrg_secret")
    monkeypatch.setenv("VERGENCE_TOKEN", "vrg_secret")
    DepthClient("grpc://depth.example:50051")  # of the environment: it is kept
    monkeypatch.delenv("VERGENCE_TOKEN")
    monkeypatch.setenv("VERGENCE_TOKEN_FILE", str(tmp_path / "none"))
    with pytest.raises(ValueError, match="cannot read the token"):
        DepthClient("grpcs://depth.example:50051")


async def test_the_environment_and_the_command_make_and_show_tokens(
    guarded: Guarded, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def command(*words: str) -> subprocess.CompletedProcess[str]:
        code = (
            "import typer; from vergence_service.app.token_command import token; "
            "app = typer.Typer(); app.command()(token); app()"
        )
        file = ("--file", str(tmp_path / "tokens.toml"))
        return subprocess.run(
            [sys.executable, "-c", code, *words, *file], capture_output=True, text=True, check=False
        )

    made = (await asyncio.to_thread(command, "add", "cyd", "--role", "admin")).stdout.strip()
    text = (tmp_path / "tokens.toml").read_text()
    assert made.startswith("vrg_")
    assert made not in text
    assert stat.S_IMODE((tmp_path / "tokens.toml").stat().st_mode) == 0o600
    assert "cyd\tadmin" in (await asyncio.to_thread(command, "list")).stdout
    assert (await asyncio.to_thread(command, "remove", "cyd")).returncode == 0
    assert (await asyncio.to_thread(command, "remove", "cyd")).returncode == 2

    (tmp_path / "token").write_text(guarded.file.tokens["ana"] + "\n")
    monkeypatch.setenv("VERGENCE_TOKEN_FILE", str(tmp_path / "token"))
    for address in (
        f"grpc://{guarded.server.grpc_address}",
        f"http://{guarded.server.http_address}",
    ):
        async with DepthClient(address) as client:
            assert (await client.server_info()).streams_max == 64
    async with httpx.AsyncClient() as plain:
        answer = await plain.get(f"http://{guarded.server.http_address}/v1/sequences")
    assert answer.status_code == 401


async def test_a_page_of_a_named_origin_may_call() -> None:
    page, body = "https://app.example", pb.GetServerInfoRequest().SerializeToString()
    url, foreign = "/v1/methods/GetServerInfo", {"Sec-Fetch-Site": "cross-site"}
    async with (
        running_server(RecallModel(), security__origins=[page]) as server,
        http_to(server) as http,
    ):
        preflight = {"Origin": page, "Access-Control-Request-Method": "POST", **foreign}
        asked = await http.options(url, headers=preflight)
        assert (asked.status_code, asked.headers["access-control-allow-origin"]) == (204, page)
        assert "Authorization" in asked.headers["access-control-allow-headers"]
        headers = {**PROTOBUF, **foreign}
        answer = await http.post(url, content=body, headers={**headers, "Origin": page})
        assert (answer.status_code, answer.headers["access-control-allow-origin"]) == (200, page)
        info = pb.GetServerInfoResponse.FromString(answer.content)
        assert set(info.capabilities) == set(Capability)
        for other in (f"{page}.evil.example", "http://app.example", "null"):
            refused = await http.post(url, content=body, headers={**headers, "Origin": other})
            assert refused.status_code == 403
            assert "access-control-allow-origin" not in refused.headers


@pytest.mark.parametrize(
    ("traceparent", "found"),
    [
        ("00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01", True),
        ("00-00000000000000000000000000000000-00f067aa0ba902b7-01", False),
        ("00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7", False),
        ("00-4bf92f3577b34da6a3ce929d0e0e4736 event=forged-00f067aa0ba902b7-01", False),
    ],
    ids=["valid", "of zeros", "cut", "with words"],
)
async def test_the_log_names_the_trace_of_a_client(
    traceparent: str, found: bool, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    body = open_message("over-http").SerializeToString()
    async with (
        running_server(RecallModel()) as server,
        stub(server) as calls,
        http_to(server) as http,
    ):
        headers = {"traceparent": traceparent}
        async with http.stream("POST", "/v1/streams", content=body, headers=PROTOBUF | headers):
            pass
        metadata = tuple(headers.items())
        await RawCall(calls.StreamDepth(metadata=metadata)).ask(open_message("over-grpc"))
    opened = [each.getMessage() for each in caplog.records if "stream opened" in each.getMessage()]
    assert len(opened) == 2
    assert all(("trace_id=4bf92f3577b34da6a3ce929d0e0e4736" in each) is found for each in opened)
