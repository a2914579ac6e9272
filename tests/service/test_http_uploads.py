"""Forms, images and uploads that are not what they should be are refused, or fail their job."""

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest

from tests.support.http import ended, http_server, http_to, reason_of, submit
from tests.support.models import RecallModel
from tests.support.polling import eventually
from tests.support.sequences import (
    CALIBRATION,
    make_frames,
    png,
    sequence_files,
    with_size,
    zip_bytes,
)
from tests.support.server import PATIENCE_S, running_server

FILES = dict(sequence_files(make_frames(2)))

FORMS: dict[str, tuple[list[tuple[str, bytes]], str]] = {
    "no calibration": ([("left", b"x"), ("right", b"x")], "sequence"),
    "calibration without a baseline": (
        [("left", b"x"), ("right", b"x"), ("sequence", b'{"calibration": {"width": 3}}')],
        "baseline_m",
    ),
    "not JSON": ([("left", b"x"), ("right", b"x"), ("sequence", b"{")], "JSON"),
    "one image too few": (
        [
            ("left", png(make_frames(1)[0].left)),
            ("left", png(make_frames(1)[0].left)),
            ("right", png(make_frames(1)[0].right)),
            ("sequence", json.dumps({"calibration": CALIBRATION}).encode()),
        ],
        "2 left, 1 right",
    ),
    "no image": (
        [
            ("left", b"GIF89a"),
            ("right", b"GIF89a"),
            ("sequence", json.dumps({"calibration": CALIBRATION}).encode()),
        ],
        "PNG, JPEG or WebP",
    ),
    "two archives": ([("archive", b"PK"), ("archive", b"PK")], "archive"),
}


async def test_forms_are_refused_with_what_they_lack(tmp_path: Path) -> None:
    async with http_server(RecallModel(), batch__directory=tmp_path) as client:
        for what, (files, says) in FORMS.items():
            answer = await client.post("/v1/sequences", files=files)
            assert reason_of(answer) == "BAD_SEQUENCE", what
            assert says in answer.text, (what, answer.text)
        cut = await client.post(
            "/v1/sequences",
            content=b'--b\r\nContent-Disposition: form-data; name="left"\r\n\r\nhalf',
            headers={"Content-Type": "multipart/form-data; boundary=b"},
        )
        assert "cut off" in cut.text
        assert not [*(tmp_path / "incoming").iterdir(), *(tmp_path / "jobs").iterdir()]


async def test_an_image_that_cannot_be_read_fails_its_job_and_names_it() -> None:
    files = {**FILES, "frame_0001_left.png": png(make_frames(1)[0].left[:20])}
    async with http_server(RecallModel()) as client:
        job = await ended(client, (await submit(client, zip_bytes(files.items())))["id"])
    assert (job["state"], job["reason"]) == ("failed", "BAD_SEQUENCE")
    assert job["message"].startswith("frame_0001_left.png: expected 64x48")


PAIR = {"left": png(make_frames(1)[0].left), "right": png(make_frames(1)[0].right)}
HUGE_PNG = with_size(PAIR["left"], 32_000, 32_000)


@pytest.mark.parametrize(
    ("files", "query", "reason"),
    [
        pytest.param({"left": PAIR["left"]}, "", "BAD_IMAGE", id="one image"),
        pytest.param({**PAIR, "left": b"x"}, "", "BAD_IMAGE", id="no image"),
        pytest.param(
            {**PAIR, "left": HUGE_PNG},
            "",
            "FRAME_TOO_LARGE",
            id="absurd size",
        ),
        pytest.param(
            {**PAIR, "left": png(make_frames(1)[0].left[:20])}, "", "BAD_SHAPE", id="two sizes"
        ),
        pytest.param(PAIR, "?output=depth", "BAD_CALIBRATION", id="depth of no camera"),
        pytest.param(PAIR, "?format=gif", "BAD_SHAPE", id="format"),
    ],
)
async def test_a_bad_pair_is_refused(files: dict[str, bytes], query: str, reason: str) -> None:
    async with http_server(RecallModel()) as client:
        answer = await client.post(f"/v1/pairs{query}", files=files)
    assert answer.status_code in (400, 413)
    assert reason_of(answer) == reason


async def test_an_upload_that_breaks_off_or_stalls_leaves_nothing_behind(tmp_path: Path) -> None:
    flags: dict[str, Any] = {"batch__directory": tmp_path, "batch__idle_s": 0.2}
    incoming = tmp_path / "incoming"
    async with running_server(RecallModel(), **flags) as server, http_to(server) as client:
        host, port = server.http_address.split(":")
        for breaks_off in (True, False):
            reader, writer = await asyncio.open_connection(host, int(port))
            writer.write(
                b"POST /v1/sequences HTTP/1.1\r\nHost: here\r\nContent-Type: application/zip\r\n"
                b"Connection: close\r\nContent-Length: 1000000\r\n\r\nPK\x03\x04"
            )
            await writer.drain()
            await holds_something(incoming)
            if not breaks_off:
                answer = await asyncio.wait_for(reader.read(), PATIENCE_S)
                assert b"408 Request Timeout" in answer
                assert b"too slowly: 4 bytes came" in answer
            writer.close()
            await emptied(incoming)
        await submit(client, zip_bytes(FILES.items()))


def is_empty(folder: Path) -> bool:
    return not any(folder.iterdir())


async def holds_something(folder: Path) -> None:
    await eventually(lambda: not is_empty(folder))


async def emptied(folder: Path) -> None:
    await eventually(lambda: is_empty(folder))
