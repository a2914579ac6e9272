"""Jobs live on disk: through restarts, until they are too old or the room is needed."""

import asyncio
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from tests.support.frames import frame_message, make_frame
from tests.support.http import (
    ZIP,
    disparities,
    ended,
    files_below,
    http_server,
    http_to,
    is_known,
    metrics_of,
    reason_of,
    state_of,
    submit,
)
from tests.support.models import RAISES, RecallModel
from tests.support.polling import eventually
from tests.support.sequences import make_frames, sequence_files, zip_bytes
from tests.support.server import raw_stream, running_server
from vergence_proto.jobs import JobState
from vergence_service.jobs.store import JobStore

ARCHIVE = zip_bytes(sequence_files(make_frames(6)))


async def test_a_stopped_server_leaves_its_jobs_to_the_next_one(tmp_path: Path) -> None:
    model = RecallModel()
    async with http_server(model, batch__directory=tmp_path) as client:
        done = await submit(client, ARCHIVE)
        await ended(client, done["id"])
        maps = await disparities(client, done["id"])
        with model.busy():
            jobs = [await submit(client, ARCHIVE) for _ in range(3)]
            await asyncio.to_thread(model.wait_until_entered)
            # The model is freed by a thread of its own, when the server has begun to stop.
            asyncio.get_running_loop().call_later(0.2, model.let_go)
            await client.aclose()
    async with http_server(RecallModel(), batch__directory=tmp_path) as client:
        for job in jobs:
            assert (await ended(client, job["id"]))["state"] == "done"
            np.testing.assert_array_equal(await disparities(client, job["id"]), maps)
        np.testing.assert_array_equal(await disparities(client, done["id"]), maps)


async def test_a_sequence_that_keeps_killing_the_server_is_given_up(tmp_path: Path) -> None:
    model = RecallModel()
    async with http_server(model, batch__directory=tmp_path) as client:
        with model.busy():
            deadly = await submit(client, ARCHIVE)
            asyncio.get_running_loop().call_later(0.2, model.let_go)
            await client.aclose()
    with JobStore(tmp_path) as store:  # as four servers would have left it
        [job] = store.load()
        store.update(replace(job, state=JobState.RUNNING, attempts=4))
    async with http_server(RecallModel(), batch__directory=tmp_path) as client:
        failed = await ended(client, deadly["id"])
    assert (failed["state"], failed["reason"]) == ("failed", "MODEL_FAILED")
    assert "died 4 times" in failed["message"]


async def test_prometheus_hears_of_sequences() -> None:
    async def of_sequences(client: httpx.AsyncClient) -> dict[str, float]:
        lines = (await metrics_of(client)).splitlines()
        pairs = (line.rsplit(" ", 1) for line in lines if line.startswith("vergence_sequence"))
        return {name.removeprefix("vergence_"): float(value) for name, value in pairs}

    model = RecallModel()
    async with http_server(model) as client:
        with model.busy():
            jobs = [await submit(client, ARCHIVE) for _ in range(3)]
            await asyncio.to_thread(model.wait_until_entered)
            waiting = await of_sequences(client)
        good = [await ended(client, job["id"]) for job in jobs]
        bad_frames = [*make_frames(2), make_frame(3, brightness=RAISES)]
        bad = await submit(client, zip_bytes(sequence_files(bad_frames)))
        assert (await ended(client, bad["id"]))["state"] == "failed"
        after = await of_sequences(client)
    assert waiting['sequences{state="queued"}'] == 2
    assert waiting['sequences{state="running"}'] == 1
    assert waiting["sequence_disk_bytes"] > 0
    assert after['sequences{state="queued"}'] == after['sequences{state="running"}'] == 0
    assert after["sequences_done_total"] == after["sequence_seconds_count"] == 3
    assert after['sequences_failed_total{reason="MODEL_FAILED"}'] == 1
    assert after["sequence_frames_total"] >= sum(job["frames"] for job in good)


async def test_results_expire_by_age(tmp_path: Path) -> None:
    async with http_server(RecallModel(), batch__directory=tmp_path) as client:
        job = await submit(client, ARCHIVE)
        await ended(client, job["id"])
        assert files_below(tmp_path / "jobs")
    async with http_server(RecallModel(), batch__directory=tmp_path, batch__keep_h=1e-9) as client:
        await eventually(lambda: not any((tmp_path / "jobs").iterdir()))
        assert not await is_known(client, job["id"])


async def test_no_result_makes_room_for_another_before_it_expires(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    archive = zip_bytes(sequence_files(make_frames(16)))
    flags: dict[str, Any] = {"batch__directory": tmp_path, "batch__disk_mib": 1}
    query = {"output": ["disparity", "left"]}
    async with http_server(RecallModel(), **flags) as client:
        kept = []
        while True:
            answer = await client.post("/v1/sequences", params=query, content=archive, headers=ZIP)
            if answer.status_code != 202:
                break
            kept.append(await ended(client, answer.json()["id"]))
        assert len(kept) > 2
        assert (answer.status_code, reason_of(answer)) == (429, "QUEUE_FULL")
        assert "batch.disk_mib" in answer.text
        assert int(answer.headers["Retry-After"]) >= 1
        assert "refused" in caplog.text
        assert "vergence_sequences_refused_total 1.0" in (await metrics_of(client))
        for job in kept:
            assert len(await disparities(client, job["id"])) == 16
            assert datetime.fromisoformat(job["expires"]) > datetime.now(UTC) + timedelta(hours=23)
        await client.delete(f"/v1/sequences/{kept[0]['id']}")
        await submit(client, archive)
        whale = zip_bytes(sequence_files(make_frames(120)))
        answer = await client.post("/v1/sequences", content=whale, headers=ZIP)
        assert (answer.status_code, reason_of(answer)) == (413, "UPLOAD_TOO_LARGE")


async def test_a_second_server_on_the_same_folder_serves_live_and_says_why_not_more(
    tmp_path: Path,
) -> None:
    async with (
        http_server(RecallModel(), batch__directory=tmp_path),
        running_server(RecallModel(), batch__directory=tmp_path) as server,
        http_to(server) as client,
    ):
        answer = await client.post("/v1/sequences", content=ARCHIVE, headers=ZIP)
        assert (answer.status_code, reason_of(answer)) == (503, "NOT_READY")
        assert "batch.directory" in answer.text
        async with raw_stream(server) as call:
            assert (await call.ask(frame_message(make_frame(1)))).disparity.frame_id == 1


async def test_as_many_jobs_are_stepped_as_the_model_has_lanes() -> None:
    model = RecallModel(max_concurrent_steps=2)
    async with http_server(model) as client:
        with model.busy():
            jobs = [await submit(client, ARCHIVE) for _ in range(3)]
            for _ in range(2):
                await asyncio.to_thread(model.wait_until_entered)
            states = [await state_of(client, job["id"]) for job in jobs]
        done = [await ended(client, job["id"]) for job in jobs]
        maps = [await disparities(client, job["id"]) for job in jobs]
    assert states == ["running", "running", "queued"]
    assert [job["state"] for job in done] == ["done"] * 3
    np.testing.assert_array_equal(maps[0], maps[1])
    np.testing.assert_array_equal(maps[0], maps[2])
