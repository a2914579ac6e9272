"""Jobs that run again on the input they kept, the order of jobs, and the room of uploads."""

import asyncio
import os
from pathlib import Path

import httpx
import numpy as np

from tests.support.http import disparities, ended, http_server, reason_of, submit
from tests.support.models import RecallModel
from tests.support.polling import eventually
from tests.support.sequences import make_frames, sequence_files, zip_bytes

ARCHIVE = zip_bytes(sequence_files(make_frames(4)))


async def test_a_job_that_kept_its_input_runs_again_with_other_options(tmp_path: Path) -> None:
    async with http_server(RecallModel(), batch__directory=tmp_path) as client:
        job = await submit(client, ARCHIVE, keep_input=True, label="robot:r2", metrics=True)
        other = await submit(client, ARCHIVE)
        await ended(client, other["id"])
        await ended(client, job["id"])
        url = f"/v1/sequences/{job['id']}/rerun"
        key = {"Idempotency-Key": '"once"'}
        again = await client.post(url, params={"quality": "steady"}, headers=key)
        assert again.status_code == httpx.codes.ACCEPTED, again.text
        first = again.json()
        repeated = await client.post(url, params={"quality": "steady"}, headers=key)
        assert repeated.json()["id"] == first["id"]
        other_options = await client.post(url, params={"quality": "best"}, headers=key)
        assert reason_of(other_options) == "KEY_REUSED"
        assert (first["quality"], first["metrics"]) == ("steady", True)
        assert first["labels"] == {"robot": "r2"}
        second = (await client.post(url)).json()
        for each in (first, second):
            assert (await ended(client, each["id"]))["state"] == "done"
        np.testing.assert_array_equal(
            await disparities(client, second["id"]), await disparities(client, other["id"])
        )
        assert (tmp_path / "jobs" / job["id"] / "input").is_dir()
        assert not (tmp_path / "jobs" / second["id"] / "input").exists()
        refused = await client.post(f"/v1/sequences/{other['id']}/rerun")
        assert reason_of(refused) == "SEQUENCE_NOT_DONE"
        assert "keep_input" in refused.json()["detail"]


async def test_the_next_job_is_the_oldest_of_the_highest_priority() -> None:
    model = RecallModel()
    async with http_server(model) as client:
        with model.busy():
            jobs = [await submit(client, ARCHIVE)]
            await asyncio.to_thread(model.wait_until_entered)
            order = ("low", "normal", "high", "normal")
            jobs += [await submit(client, ARCHIVE, priority=each) for each in order]
            found = [(await client.get(f"/v1/sequences/{job['id']}")).json() for job in jobs]
        assert [job["ahead"] for job in found] == [0, 4, 2, 1, 3]
        for job in jobs:
            assert (await ended(client, job["id"]))["state"] == "done"


async def test_announced_uploads_take_room_while_they_go_on(tmp_path: Path) -> None:
    flags = {"batch__directory": tmp_path, "batch__disk_mib": 1}
    length = {"Tus-Resumable": "1.0.0", "Upload-Length": str(600 << 10)}
    async with http_server(RecallModel(), **flags) as client:
        assert (await client.post("/v1/uploads", headers=length)).status_code == 201
        refused = await client.post("/v1/uploads", headers=length)
        assert reason_of(refused) == "QUEUE_FULL"
        assert "batch.disk_mib" in refused.json()["detail"]
        [body] = (tmp_path / "uploads").glob("*/body")
        silent_s = body.stat().st_mtime - 3600
        os.utime(body, (silent_s, silent_s))
        assert (await client.post("/v1/uploads", headers=length)).status_code == 201
        never = await client.post("/v1/uploads", headers={**length, "Upload-Length": str(2 << 20)})
        assert reason_of(never) == "UPLOAD_TOO_LARGE"


async def test_uploads_that_nobody_finishes_are_removed_while_the_server_runs(
    tmp_path: Path,
) -> None:
    length = {"Tus-Resumable": "1.0.0", "Upload-Length": "9"}
    async with http_server(RecallModel(), batch__directory=tmp_path) as client:
        assert (await client.post("/v1/uploads", headers=length)).status_code == 201
    [body] = (tmp_path / "uploads").glob("*/body")
    almost_s = body.stat().st_mtime - 24 * 3600 + 1.5
    os.utime(body, (almost_s, almost_s))
    async with http_server(RecallModel(), batch__directory=tmp_path):
        await eventually(lambda: not any((tmp_path / "uploads").iterdir()))
