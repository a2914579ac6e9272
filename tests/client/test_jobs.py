"""Jobs from a program: submitted once, read as they are made, through cut lines and restarts."""

import asyncio
import json
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.frames import RIG
from tests.support.http import as_kept
from tests.support.models import NOT_FINITE, PacedModel, RecallModel
from tests.support.proxy import proxy_to
from tests.support.sequences import make_frames, sequence_files, write_sequence, zip_bytes
from tests.support.server import running_server
from vergence import (
    AsyncBatchClient,
    BadSequence,
    BadShape,
    BatchClient,
    ConnectionLost,
    JobState,
    NonFinite,
    SequenceNotDone,
    UnknownSequence,
)
from vergence.jobs.packing import find_upload
from vergence_proto.datasets import read_pfm

FRAMES = make_frames(6)


@dataclass
class Serving:
    address: str


@pytest.fixture(scope="module")
def serving() -> Iterator[Serving]:
    """A server in a thread of its own, as a notebook has it elsewhere."""
    addresses: list[str] = []
    started, stop = threading.Event(), threading.Event()

    async def serve() -> None:
        async with running_server(RecallModel()) as server:
            addresses.append(f"http://{server.http_address}")
            started.set()
            await asyncio.to_thread(stop.wait)

    thread = threading.Thread(target=asyncio.run, args=(serve(),))
    thread.start()
    assert started.wait(timeout=20)
    yield Serving(addresses[0])
    stop.set()
    thread.join(timeout=20)


def arrays() -> list[tuple[Any, ...]]:
    return [(frame.left, frame.right, pose_of(frame)) for frame in FRAMES]


def pose_of(frame: Any) -> Any:
    return frame.pose.world_from_left


def test_a_folder_an_archive_a_source_and_arrays_are_one_sequence(
    serving: Serving, tmp_path: Path
) -> None:
    client = BatchClient(serving.address)
    folder = write_sequence(tmp_path / "room", FRAMES)
    archive = tmp_path / "room.zip"
    archive.write_bytes(zip_bytes(sequence_files(FRAMES)))
    maps = []
    sources: list[tuple[Any, dict[str, Any]]] = [
        (folder, {}),
        (archive, {}),
        (f"vergence:{folder}", {}),
        (arrays(), {"rig": RIG, "fps": 1e9 / 33e6}),
    ]
    for source, more in sources:
        job = client.submit(source, outputs=["sigma"], name="room", **more)
        frames = list(job.frames())
        assert [frame.index for frame in frames] == [*range(6)]
        maps.append([frame.disparity_px for frame in frames])
        last = frames[-1]
        assert last.map is not None
        assert last.rig == RIG
        assert last.origin == "warm"
        assert last.capture_ns == 5 * 33_000_000
        np.testing.assert_array_equal(last.sigma_px, np.full((48, 64), 0.5))
        assert last.world_from_left is not None
        np.testing.assert_array_equal(last.world_from_left.matrix, pose_of(FRAMES[5]).matrix)
        xyz_m, rgb = last.points()
        assert xyz_m.shape == rgb.shape == (48 * 64, 3)
        assert client.job(job.id).wait().name == "room"
    for other in maps[1:]:
        np.testing.assert_array_equal(other, maps[0])
    assert not np.isnan(as_kept(maps[0])).any()


def test_a_result_is_saved_in_any_layout_and_replaced_by_the_next(
    serving: Serving, tmp_path: Path
) -> None:
    client = BatchClient(serving.address)
    folder = write_sequence(tmp_path / "room", FRAMES)
    job = client.submit(folder, outputs=["depth", "left"])
    out = job.save(tmp_path / "out", format="pfm")
    frames = list(job.frames())
    depth_m = frames[3].depth_m
    assert depth_m is not None
    np.testing.assert_array_equal(read_pfm(out / "depth" / "0003.pfm"), depth_m)
    assert json.loads((out / "manifest.json").read_text())["counts"]["done"] == 6
    job.save(out, format="nerfstudio")
    assert not (out / "depth").exists() or not any((out / "depth").iterdir())
    scene = json.loads((out / "transforms.json").read_text())
    assert all((out / each["depth_file_path"]).is_file() for each in scene["frames"])
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    with pytest.raises(FileExistsError, match="no results"):
        job.save(tmp_path / "mine")
    with pytest.raises(BadShape, match="nerfstudio"):
        job.save(tmp_path / "new", format="gif")  # type: ignore[arg-type] # on purpose
    film = job.download(tmp_path / "film.mp4")
    assert film.stat().st_size > 1000
    job.delete()
    with pytest.raises(UnknownSequence):
        job.refresh()


def test_a_job_runs_again_on_the_input_it_has_kept(serving: Serving, tmp_path: Path) -> None:
    client = BatchClient(serving.address)
    folder = write_sequence(tmp_path / "room", FRAMES)
    job = client.submit(
        folder, outputs=["sigma"], labels={"robot": "r2"}, priority="high", keep_input=True
    )
    job.wait()
    again = job.rerun(quality="steady", priority="low")
    assert again.id != job.id
    assert again.info.labels == {"robot": "r2"}
    frames = list(again.frames())
    assert all(frame.sigma_px is not None for frame in frames)
    assert again.manifest()["options"]["quality"] == "steady"
    with pytest.raises(SequenceNotDone, match="keep_input"):
        again.rerun()


def test_frames_without_a_map_and_failed_jobs_say_why(serving: Serving, tmp_path: Path) -> None:
    client = BatchClient(serving.address)
    bad = make_frames(4)
    bad[2].left[0, 0] = NOT_FINITE
    folder = write_sequence(tmp_path / "bad", bad)
    frames = list(client.submit(folder).frames())
    assert [frame.error is None for frame in frames] == [True, True, False, True]
    assert frames[2].depth_m is None
    job = client.submit(folder, on_error="fail")
    coming = job.frames()
    assert [next(coming).index, next(coming).index] == [0, 1]
    with pytest.raises(NonFinite, match="not finite"):
        next(coming)
    with pytest.raises(NonFinite):
        job.save(tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out" / "disparity").iterdir()) == [
        "0000.png",
        "0001.png",
    ]
    assert job.refresh().state is JobState.FAILED


def test_what_is_no_sequence_is_refused_before_anything_is_sent(tmp_path: Path) -> None:
    client = BatchClient("http://127.0.0.1:1", patience_s=0)
    for path in (tmp_path, tmp_path / "nothing"):
        with pytest.raises(BadSequence, match=str(path)):
            client.submit(path)
    with pytest.raises(ValueError, match="rig"):
        client.submit(arrays())
    with pytest.raises(ConnectionLost, match="cannot reach"):
        client.submit(write_sequence(tmp_path / "room", FRAMES[:1]))


def test_a_folder_is_sent_as_the_same_bytes_from_any_offset(tmp_path: Path) -> None:
    upload = find_upload(write_sequence(tmp_path / "room", FRAMES[:2]))

    async def sent(start: int) -> bytes:
        return b"".join([chunk async for chunk in upload.chunks(start)])

    whole = asyncio.run(sent(0))
    assert len(whole) == upload.size()
    for start in (1, 511, 512, 1000, len(whole) - 600, len(whole) - 1, len(whole)):
        assert asyncio.run(sent(start)) == whole[start:], start


@pytest.mark.slow
async def test_a_job_is_followed_through_cut_lines_and_a_restart(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path / "room", make_frames(40))
    jobs = tmp_path / "jobs"
    async with (
        running_server(RecallModel()) as server,
        AsyncBatchClient(server.http_address) as client,
    ):
        expected = [frame.disparity_px async for frame in (await client.submit(folder)).frames()]
    found: list[Any] = []
    async with (
        running_server(PacedModel(0.03), batch__directory=jobs) as server,
        proxy_to(server.http_address) as proxy,
        AsyncBatchClient(proxy.address) as client,
    ):
        job = await client.submit(folder)

        async def collect() -> None:
            async for frame in job.frames():
                found.append(frame.disparity_px)
                if len(found) in (3, 6):
                    proxy.cut()
                    asyncio.get_running_loop().call_later(0.05, proxy.mend)

        going = asyncio.create_task(collect())
        while len(found) < 8:  # noqa: ASYNC110  as a user looks on
            await asyncio.sleep(0.01)
        proxy.cut()
        going.cancel()
        await asyncio.gather(going, return_exceptions=True)
    assert len(found) < 40
    async with (
        running_server(RecallModel(), batch__directory=jobs) as server,
        AsyncBatchClient(server.http_address) as client,
    ):
        job = await client.job(job.id)
        found += [each.disparity_px async for each in job.frames(after=len(found) - 1)]
    np.testing.assert_array_equal(found, expected)


async def test_a_submission_whose_answer_was_lost_is_accepted_once(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path / "room", FRAMES)
    jobs = tmp_path / "jobs"
    async with running_server(RecallModel(), batch__directory=jobs) as server:
        async with (
            proxy_to(server.http_address) as proxy,
            AsyncBatchClient(proxy.address) as client,
        ):
            submitting = asyncio.create_task(client.submit(folder))
            while not any((jobs / "jobs").iterdir()):  # noqa: ASYNC110  the server tells nobody
                await asyncio.sleep(0)
            proxy.cut()  # the answer may be on its way or not
            proxy.mend()
            await (await submitting).wait()
        assert len(list((jobs / "jobs").iterdir())) == 1
