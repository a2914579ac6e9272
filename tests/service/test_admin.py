"""The administrator's listener: who is let in, and what there is to see."""

from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.support.frames import frame_message, make_frame, open_message
from tests.support.http import admin_of
from tests.support.models import RecallModel
from tests.support.polling import eventually_true
from tests.support.server import PATIENCE_S, RawCall, raw_stream, running_server
from tests.support.tokens import TokenFile, stub
from vergence_service.app.security import check_exposure
from vergence_service.settings import SettingsError, load_settings

PATHS = ("/metrics", "/v1/admin/streams", "/docs", "/", "/openapi.json")


async def test_every_open_stream_is_one_row() -> None:
    async with (
        running_server(RecallModel()) as server,
        admin_of(server) as admin,
        raw_stream(server, "mine") as call,
    ):
        for frame_id in (1, 2, 3):
            await call.ask(frame_message(make_frame(frame_id)))
        [row] = (await admin.get("/v1/admin/streams")).json()
        assert (row["principal"], row["stream_id"], row["transport"]) == ("local", "mine", "grpc")
        assert (row["frames_stepped"], row["warm_steps"], row["last_origin"]) == (3, 2, "warm")
        assert (row["address"], row["attached"]) == ("127.0.0.1", True)
        assert 0 <= row["age_p50_s"] < PATIENCE_S
        assert "vergence_streams_open 1.0" in (await admin.get("/metrics")).text


async def test_without_tokens_it_is_for_this_machine_and_for_no_foreign_page() -> None:
    async with running_server(RecallModel()) as server, admin_of(server) as admin:
        for path in PATHS:
            answer = await admin.get(path)
            assert answer.status_code == 200, path
            assert "://" not in answer.text.replace("http://www.w3.org", "") or path != "/docs"
            assert (await admin.get(path, headers={"host": "evil.example"})).status_code == 403
        closing = await admin.delete("/v1/admin/streams/local/mine")
        assert closing.status_code == 401
        base = f"http://{server.http_address}"
        async with httpx.AsyncClient(base_url=base) as public:
            for path in ("/v1/admin/streams", "/docs"):
                assert (await public.get(path)).status_code == 404
            # Only this machine can ask, and there is nobody to hide the metrics from.
            assert "vergence_streams_open 0.0" in (await public.get("/metrics")).text


async def test_with_tokens_it_is_for_administrators(tmp_path: Path) -> None:
    file = TokenFile(tmp_path / "tokens", "ana", admins=("root",))
    async with (
        running_server(RecallModel(), security__tokens=file.path) as server,
        admin_of(server) as stranger,
        admin_of(server, **file.shown("ana")) as ana,
        admin_of(server, **file.shown("root")) as root,
        stub(server) as calls,
    ):
        for path in PATHS:
            assert (await stranger.get(path)).status_code == 401
            assert (await ana.get(path)).status_code == 403
            assert (await root.get(path)).status_code == 200
        assert (await stranger.get("/healthz")).status_code == 200
        async with httpx.AsyncClient(
            base_url=f"http://{server.http_address}", headers=file.shown("root")
        ) as public:
            assert (await public.get("/metrics")).status_code == 404
        call = RawCall(calls.StreamDepth(metadata=tuple(file.shown("ana").items())))
        await call.ask(open_message("hers"))
        assert (await ana.delete("/v1/admin/streams/ana/hers")).status_code == 403
        assert (await root.delete("/v1/admin/streams/ana/hers")).status_code == 204
        assert (await root.get("/v1/admin/streams")).json() == []
        assert (await root.delete("/v1/admin/streams/ana/hers")).status_code == 404


async def test_a_browser_logs_in_with_a_token_and_keeps_a_cookie(tmp_path: Path) -> None:
    file = TokenFile(tmp_path / "tokens", "ana", admins=("root",))
    async with (
        running_server(RecallModel(), security__tokens=file.path) as server,
        admin_of(server, accept="text/html") as browser,
    ):
        sent = await browser.get("/")
        assert (sent.status_code, sent.headers["location"]) == (303, "/login")
        assert (await browser.get("/login")).status_code == 200
        foreign = {"origin": "https://evil.example"}
        for name, headers in (("nobody", {}), ("ana", {}), ("root", foreign)):
            data = {"token": file.tokens.get(name, "vrg_guessed")}
            answer = await browser.post("/login", data=data, headers=headers)
            assert answer.status_code in (401, 403, 303)
            assert "set-cookie" not in answer.headers
        answer = await browser.post("/login", data={"token": file.tokens["root"]})
        assert answer.status_code == 303
        cookie = answer.headers["set-cookie"].lower()
        assert "httponly" in cookie
        assert "samesite=strict" in cookie
        assert file.tokens["root"] not in cookie
        for path in PATHS:
            assert (await browser.get(path)).status_code == 200
        del file.tokens["root"]
        file.write()

        async def is_out() -> bool:
            return (await browser.get("/")).status_code == 303

        await eventually_true(is_out)


async def test_a_second_server_on_this_machine_takes_a_free_port() -> None:
    async with (
        running_server(RecallModel(), admin__port=None) as one,
        running_server(RecallModel(), admin__port=None) as other,
    ):
        assert one.admin_address != other.admin_address


@pytest.mark.parametrize(
    ("flags", "starts"),
    [
        ({}, True),
        ({"security.tls_cert": "c", "security.tls_key": "k", "security.client_ca": "a"}, False),
        ({"security.tls_cert": "c", "security.tls_key": "k", "security.tokens": "t"}, True),
    ],
)
def test_beyond_this_machine_it_needs_tls_and_tokens(flags: dict[str, Any], starts: bool) -> None:
    settings = load_settings(flags={**flags, "admin.host": "0.0.0.0" if flags else "127.0.0.1"})
    if starts:
        check_exposure(settings)
    else:
        with pytest.raises(SettingsError, match="--insecure"):
            check_exposure(settings)
    with pytest.raises(SettingsError, match="--insecure"):
        check_exposure(load_settings(flags={"admin.host": "0.0.0.0"}))
