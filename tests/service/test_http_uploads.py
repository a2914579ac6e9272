"""Forms, images and uploads that are not what they should be are refused, or fail their job."""

import asyncio
import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.http import ZIP, ended, http_server, http_to, reason_of, submit
from tests.support.models import RecallModel
from tests.support.polling import eventually
from tests.support.sequences import (
    CALIBRATION,
    make_frames,
    png,
    pose_numbers,
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


THREE = dict(sequence_files(make_frames(3)))


def without(*names: str) -> dict[str, bytes]:
    return {name: content for name, content in THREE.items() if name not in names}


def truth(*shape: int) -> bytes:
    file = io.BytesIO()
    np.savez(file, disp=np.ones(shape, np.uint16))
    return file.getvalue()


SMALL = png(make_frames(1)[0].left[:20])


@pytest.mark.parametrize(
    ("files", "unread", "note"),
    [
        (without("frame_0001_right.png"), [1], "frame_0001_right.png: not found"),
        (without("frame_0000_left.png"), [0], "frame_0000_left.png: not found"),
        ({**THREE, "frame_0002_left.png": SMALL}, [2], "frame_0002_left.png: expected 64x48"),
        ({**THREE, "frame_0001_gt.npz": truth(3, 3)}, [], "the truth of frame 2 is 3x3"),
        (without("frame_0001_gt.npz"), [], "1 of 3 frames have no ground truth"),
    ],
    ids=["right image", "first image", "another size", "truth of another size", "no truth"],
)
async def test_an_image_that_cannot_be_read_costs_its_own_frame(
    files: dict[str, bytes], unread: list[int], note: str
) -> None:
    async with http_server(RecallModel()) as client:
        job = await submit(client, zip_bytes(files.items()), metrics=True, output="sigma")
        job = await ended(client, job["id"])
        answer = await client.get(f"/v1/sequences/{job['id']}/result", params={"format": "npz"})
    assert job["state"] == "done", job
    assert job["frames_failed"] == len(unread)
    assert any(note in each for each in job["notes"]), job["notes"]
    with zipfile.ZipFile(io.BytesIO(answer.content)) as file:
        names = [name for name in file.namelist() if name.endswith(".npz")]
    assert names == [f"{index:04d}.npz" for index in range(3) if index not in unread]


async def test_a_frame_whose_pose_is_not_known_starts_cold() -> None:
    frames = make_frames(3)
    form = {
        "calibration": CALIBRATION,
        "poses": [pose_numbers(frames[0]), None, pose_numbers(frames[2])],
    }
    files = [("sequence", json.dumps(form).encode())]
    for frame in frames:
        files += [("left", png(frame.left)), ("right", png(frame.right))]
    async with http_server(RecallModel()) as client:
        answer = await client.post("/v1/sequences", files=files)
        assert answer.status_code == 202, answer.text
        job = await ended(client, answer.json()["id"])
    assert job["state"] == "done"
    assert job["notes"] == ["poses.txt has no pose for 1 of 3 frames, which start cold"]


async def test_a_sequence_of_which_nothing_can_be_read_is_refused() -> None:
    files = {name: SMALL if name.endswith("left.png") else file for name, file in THREE.items()}
    async with http_server(RecallModel()) as client:
        answer = await client.post("/v1/sequences", content=zip_bytes(files.items()), headers=ZIP)
        jobs = (await client.get("/v1/sequences")).json()
    assert reason_of(answer) == "BAD_SEQUENCE"
    assert answer.json()["detail"].startswith("frame_0000_left.png: expected 64x48")
    assert jobs == []


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
                b"POST /v1/sequences HTTP/1.1\r\nHost: [::1]\r\nContent-Type: application/zip\r\n"
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
