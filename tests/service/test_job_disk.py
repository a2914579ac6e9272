"""An accepted sequence is done, whatever the disk, the clock and the model do in between."""

import asyncio
import errno
import io
import os
import re
import sqlite3
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from tests.support.frames import RIG, make_frame
from tests.support.full_disk import filled, no_large_files, small_disk
from tests.support.http import (
    ZIP,
    disparities,
    ended,
    http_server,
    http_to,
    is_known,
    metrics_of,
    reason_of,
    submit,
)
from tests.support.models import PacedModel, RecallModel
from tests.support.polling import eventually, eventually_true
from tests.support.sequences import make_frames, sequence_files, zip_bytes
from tests.support.server import running_server
from vergence_proto.errors import BadSequence, InsufficientStorage, UploadTooLarge
from vergence_proto.jobs import JobState
from vergence_service.app.server import drain
from vergence_service.jobs.archive_limits import ArchiveLimits
from vergence_service.jobs.archives import unpacking
from vergence_service.jobs.storage import disk_trouble
from vergence_service.jobs.store import JobStore

ARCHIVE = zip_bytes(sequence_files(make_frames(30)))
_FREE = 1 << 40


def blank_sequence(count: int) -> bytes:
    """Images that are small files, whose maps are not."""
    frames = (replace(make_frame(i), left=BLANK, right=BLANK) for i in range(1, count + 1))
    files = (file for file in sequence_files(frames) if "_gt" not in file[0])
    return zip_bytes(files, compressed=True)


BLANK = np.zeros((RIG.height, RIG.width, 3), np.uint8)


@contextmanager
def full(means: str, folder: Path) -> Iterator[None]:
    with filled(folder) if means == "tmpfs" else no_large_files():
        yield


@pytest.mark.parametrize("means", [pytest.param("tmpfs", marks=pytest.mark.slow), "rlimit"])
async def test_a_job_waits_while_the_disk_is_full_and_loses_nothing(
    means: str, tmp_path: Path
) -> None:
    folder = tmp_path / "disk"
    disk = small_disk(folder, kib=4096) if means == "tmpfs" else nullcontext()
    flags: dict[str, Any] = {"batch__directory": folder, "batch__checkpoint_s": 0.1}
    job: dict[str, Any] = {}
    with disk:
        async with http_server(PacedModel(0.02), **flags) as http:

            async def frames_are_done() -> bool:
                job.update((await http.get(f"/v1/sequences/{job['id']}")).json())
                return int(job["frames_done"]) > 2

            async def waits() -> bool:
                job.update((await http.get(f"/v1/sequences/{job['id']}")).json())
                return job["reason"] is not None

            job.update(await submit(http, ARCHIVE))
            await eventually_true(frames_are_done)
            with full(means, folder):
                await eventually_true(waits)
                assert (job["state"], job["reason"]) == ("queued", "INSUFFICIENT_STORAGE")
                assert "continues by itself" in job["message"]
                assert (folder / "jobs" / job["id"] / "input").is_dir()
            done = await ended(http, job["id"])
            maps = await disparities(http, job["id"])
    assert (done["state"], done["reason"], done["message"]) == ("done", None, None)
    async with http_server(RecallModel()) as http:
        undisturbed = await submit(http, ARCHIVE)
        await ended(http, undisturbed["id"])
        np.testing.assert_array_equal(maps, await disparities(http, undisturbed["id"]))


async def test_what_the_disk_has_no_room_for_is_refused_before_it_is_accepted(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "disk"
    result = blank_sequence(200)  # 2.4 MB of maps
    with zipfile.ZipFile(unpacked := io.BytesIO(), "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("noise", os.urandom(1 << 14) * 128)
    with small_disk(folder, kib=2048):
        async with http_server(RecallModel(), batch__directory=folder) as http:
            for body, what in (
                (bytes(3 << 20), "the upload needs 3145728 bytes"),
                (unpacked.getvalue(), "the archive needs 2097"),
                (result, f"the result of the sequence needs {200 * 64 * 48 * 5 // 4} bytes"),
            ):
                answer = await http.post("/v1/sequences", content=body, headers=ZIP)
                assert answer.status_code == httpx.codes.INSUFFICIENT_STORAGE, answer.text
                assert reason_of(answer) == "INSUFFICIENT_STORAGE"
                assert what in answer.text
                assert "are free" in answer.text
                assert not any((folder / "incoming").iterdir())
            with filled(folder):
                answer = await http.post("/v1/sequences", content=ARCHIVE, headers=ZIP)
                assert answer.status_code == httpx.codes.INSUFFICIENT_STORAGE
            await ended(http, (await submit(http, zip_bytes(sequence_files(make_frames(2)))))["id"])


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (OSError(errno.ENOSPC, "x"), "full"),
        (OSError(errno.EROFS, "x"), "read-only"),
        (OSError(errno.EIO, "x"), "fails"),
        (OSError(errno.ENOENT, "x"), None),
        (ValueError("x"), None),
    ],
    ids=["full", "read-only", "failing", "missing", "another"],
)
def test_trouble_of_the_disk_is_distinguished_from_other_errors(
    error: Exception, says: str | None
) -> None:
    def bad_sequence() -> BadSequence:
        try:
            try:
                raise error
            except (OSError, ValueError):
                raise BadSequence("cannot read") from None
        except BadSequence as found:
            return found

    for each in (error, bad_sequence()):
        trouble = disk_trouble(each)
        assert (trouble is None) if says is None else (trouble is not None and says in trouble)


def test_trouble_of_the_database_is_trouble_of_the_disk(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", kib=256):
        database = sqlite3.connect(tmp_path / "disk" / "jobs", isolation_level=None)
        database.execute("CREATE TABLE jobs (document TEXT)")
        with filled(tmp_path / "disk"), pytest.raises(sqlite3.OperationalError) as failure:
            database.execute("INSERT INTO jobs VALUES (?)", ("x" * 100_000,))
        database.close()
    assert disk_trouble(failure.value) == "the disk is full"
    assert disk_trouble(sqlite3.ProgrammingError("x")) is None


async def half_done(tmp_path: Path) -> str:
    """A job whose server has stopped in the middle; it has a checkpoint."""
    async with (
        running_server(PacedModel(0.02), batch__directory=tmp_path) as server,
        http_to(server) as http,
    ):
        job_id = str((await submit(http, ARCHIVE))["id"])

        async def frames_are_done() -> bool:
            return int((await http.get(f"/v1/sequences/{job_id}")).json()["frames_done"]) > 2

        await eventually_true(frames_are_done)
        await drain(server, within_s=0.1)
    return job_id


@pytest.mark.parametrize("progressed", [True, False])
async def test_a_job_is_given_up_only_if_it_fails_at_the_same_frame_each_time(
    progressed: bool, tmp_path: Path
) -> None:
    job_id = await half_done(tmp_path)
    with JobStore(tmp_path) as store:  # as four servers would have left it that died
        [job] = store.load()
        reached = 1 if progressed else saved_by(tmp_path, job_id)
        store.update(replace(job, state=JobState.RUNNING, attempts=4, reached=reached))
    async with http_server(RecallModel(), batch__directory=tmp_path) as http:
        job_now = await ended(http, job_id)
    assert job_now["state"] == ("done" if progressed else "failed")
    assert progressed or f"died 4 times before frame {reached} of 30" in job_now["message"]


def saved_by(folder: Path, job_id: str) -> int:
    from vergence_service.jobs.checkpoints import saved_frames

    return saved_frames(folder / "jobs" / job_id / "checkpoint")


class SometimesFailing(RecallModel):
    """A model that raises ``failures`` times, always on the same frame."""

    def __init__(self, failures: int) -> None:
        super().__init__()
        self.failures = failures

    def step(self, steps: Any) -> Any:
        if steps[0].view.capture_ns == 5 * make_frame(1).capture_ns and self.failures:
            self.failures -= 1
            raise ArithmeticError("out of memory, this time")
        return super().step(steps)


@pytest.mark.parametrize(("failures", "state"), [(3, "done"), (99, "failed")])
async def test_a_model_that_fails_now_and_then_does_not_end_a_job(
    failures: int, state: str
) -> None:
    async with http_server(SometimesFailing(failures)) as http:
        job = await ended(http, (await submit(http, ARCHIVE))["id"])
    assert job["state"] == state
    if state == "failed":
        assert job["reason"] == "MODEL_FAILED"
        # Frames that were being written when the model failed are done again.
        assert re.search("the model failed 4 times before frame [234] of 30", job["message"])


async def test_a_clock_that_jumps_loses_no_result(tmp_path: Path) -> None:
    async with http_server(RecallModel(), batch__directory=tmp_path) as http:
        job = await submit(http, ARCHIVE)
        await ended(http, job["id"])
    with JobStore(tmp_path) as store:  # it ended in 1970, by a clock that was set since
        [kept] = store.load()
        store.update(replace(kept, finished_s=0.0, created_s=0.0))
    async with http_server(RecallModel(), batch__directory=tmp_path) as http:
        younger = await submit(http, ARCHIVE)
        await ended(http, younger["id"])
        assert len(await disparities(http, job["id"])) == 30
    with JobStore(tmp_path) as store:  # servers have run for a day since
        store.update(replace(kept, finished_up_s=store.uptime_s() - 24 * 3600 - 1))
    async with http_server(RecallModel(), batch__directory=tmp_path) as http:
        await eventually(lambda: not (tmp_path / "jobs" / job["id"]).exists())
        assert not await is_known(http, job["id"])
        assert await is_known(http, younger["id"])


async def test_results_of_two_models_never_mix(tmp_path: Path) -> None:
    job_id = await half_done(tmp_path)
    checkpoint = tmp_path / "jobs" / job_id / "checkpoint"
    assert checkpoint.exists()
    other = RecallModel()
    other.card = replace(other.card, weights_sha256="1" * 64)
    async with http_server(other, batch__directory=tmp_path) as http:
        with other.busy():
            await asyncio.to_thread(other.wait_until_entered)
            assert not checkpoint.exists()  # should this server die now, nothing of it is continued
        job = await ended(http, job_id)
        metrics = await metrics_of(http)
    assert job["state"] == "done"
    assert "vergence_sequence_frames_total 30.0" in metrics


async def test_an_upload_takes_its_place_when_it_is_complete() -> None:
    async with running_server(RecallModel(), batch__waiting=1) as server, http_to(server) as http:
        slow = [await asyncio.open_connection(*server.http_address.split(":")) for _ in range(3)]
        for _, writer in slow:
            writer.write(
                b"POST /v1/sequences HTTP/1.1\r\nHost: [::1]\r\nContent-Length: 1000000\r\n"
                b"Content-Type: application/zip\r\n\r\nPK"
            )
        job = await submit(http, ARCHIVE)
        assert (await ended(http, job["id"]))["state"] == "done"
        for _, writer in slow:
            writer.close()


async def test_a_client_that_leaves_stops_the_unpacking_of_its_upload(tmp_path: Path) -> None:
    names = 20_000
    with zipfile.ZipFile(body := io.BytesIO(), "w") as archive:
        for index in range(names):
            archive.writestr(f"{index}", b"")
    incoming = tmp_path / "incoming"
    async with running_server(RecallModel(), batch__directory=tmp_path) as server:
        content = body.getvalue()
        _, writer = await asyncio.open_connection(*server.http_address.split(":"))
        head = f"POST /v1/sequences HTTP/1.1\r\nHost: [::1]\r\nContent-Length: {len(content)}\r\n"
        writer.write(head.encode() + b"Content-Type: application/zip\r\n\r\n" + content)
        await eventually(lambda: next(incoming.glob("*/input/*"), None))
        writer.close()
        most = 0
        while folders := list(incoming.iterdir()):
            most = max(most, *(sum(1 for _ in each.rglob("*")) for each in folders))
            await asyncio.sleep(0.001)
    assert most < names


@pytest.mark.parametrize(
    ("limits", "refusal"),
    [
        ({"max_files": 2}, "at most 2 files"),
        ({"max_unpacked_bytes": 2000}, "unpacks to more than 2000 bytes"),
    ],
    ids=["names", "bytes"],
)
def test_a_directory_is_counted_before_anything_is_unpacked(
    limits: dict[str, Any], refusal: str, tmp_path: Path
) -> None:
    archive = tmp_path / "archive"
    archive.write_bytes(zip_bytes((name, bytes(100)) for name in ("a", "b", "c", "d")))
    usual = {"max_files": 100, "max_unpacked_bytes": _FREE, "max_ratio": 1e6}
    target = tmp_path / "target"
    target.mkdir()
    with pytest.raises(UploadTooLarge, match=refusal):
        list(unpacking(archive, target, ArchiveLimits(**{**usual, **limits})))
    assert not any(target.iterdir())


async def test_limits_follow_the_free_space_of_the_disk(tmp_path: Path) -> None:
    def announced(kib: int) -> dict[str, str]:
        return {"Tus-Resumable": "1.0.0", "Upload-Length": str(kib << 10)}

    with small_disk(tmp_path, kib=4096):
        async with http_server(RecallModel(), batch__directory=tmp_path) as client:
            refused = await client.post("/v1/uploads", headers=announced(4200))
            assert refused.status_code == 413
            assert "batch.max_upload_mib" in refused.json()["detail"]
            assert (await client.post("/v1/uploads", headers=announced(2000))).status_code == 201
            refused = await client.post("/v1/uploads", headers=announced(2100))
            assert refused.status_code == httpx.codes.INSUFFICIENT_STORAGE


def test_an_archive_that_the_disk_has_no_room_for_is_not_unpacked(tmp_path: Path) -> None:
    archive = tmp_path / "archive"
    archive.write_bytes(zip_bytes([("zeros", bytes(1 << 20))], compressed=True))
    limits = ArchiveLimits(max_files=100, max_unpacked_bytes=_FREE, max_ratio=1e6)
    with small_disk(tmp_path / "disk", kib=256):
        with pytest.raises(InsufficientStorage, match="1049088 bytes or more"):
            list(unpacking(archive, tmp_path / "disk", limits))
        assert not any((tmp_path / "disk").iterdir())
