"""The frames of a job are resources of their own, which can be read while it runs."""

import asyncio
import io
import json
import zipfile
from typing import Any

import cv2
import httpx
import numpy as np
import pytest

from tests.support.frames import RIG
from tests.support.http import disparities, ended, http_server, reason_of, submit
from tests.support.models import NOT_FINITE, RecallModel
from tests.support.sequences import make_frames, sequence_files, zip_bytes
from vergence_proto.job_results.frame_file import decode_frame

ARCHIVE = zip_bytes(sequence_files(make_frames(12)))


class StopsAt(RecallModel):
    """A model that stays in its step number ``count`` until it is let go."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self._count = count

    def step(self, steps: Any) -> Any:
        if len(self.batches) == self._count:
            self._free.clear()
        return super().step(steps)


async def lines(client: httpx.AsyncClient, job_id: str, **query: Any) -> tuple[list[Any], bool]:
    answer = await client.get(f"/v1/sequences/{job_id}/frames", params=query)
    assert answer.status_code == 200, answer.text
    found = [json.loads(line) for line in answer.text.splitlines()]
    return found, answer.headers["Vergence-Ended"] == "true"


async def test_frames_are_read_while_the_job_runs_and_never_change() -> None:
    model = StopsAt(9)  # of nine stepped frames, four may wait to be counted
    async with http_server(model) as client:
        job_id = (await submit(client, ARCHIVE, output=["disparity", "sigma"]))["id"]
        records: list[Any] = []
        while len(records) < 5:
            found, over = await lines(client, job_id, after=len(records) - 1, wait_s=20)
            records += found
            assert not over
        early = await client.get(f"/v1/sequences/{job_id}/frames/2")
        late = await client.get(f"/v1/sequences/{job_id}/frames/11")
        assert (late.status_code, reason_of(late)) == (409, "SEQUENCE_NOT_DONE")
        manifest = (await client.get(f"/v1/sequences/{job_id}/manifest")).json()
        assert manifest["state"] == "running"
        model.let_go()
        over = False
        while not over:
            found, over = await lines(client, job_id, after=len(records) - 1, wait_s=20)
            records += found
        maps = await disparities(client, job_id)
        again = await client.get(f"/v1/sequences/{job_id}/frames/2")
        tag = {"If-None-Match": early.headers["ETag"]}
        unchanged = await client.get(f"/v1/sequences/{job_id}/frames/2", headers=tag)
    assert [each["index"] for each in records] == [*range(12)]
    assert again.content == early.content
    assert (unchanged.status_code, unchanged.content) == (304, b"")
    frame = decode_frame(early.content, RIG)
    assert frame.disparity is not None
    np.testing.assert_array_equal(frame.disparity.offset_px, maps[2])
    assert frame.record.capture_ns == frame.disparity.capture_ns
    assert frame.record.mean_sigma_px == pytest.approx(0.5)


async def test_each_file_of_a_frame_is_that_of_the_archive() -> None:
    outputs = ["disparity", "depth", "confidence", "sigma", "left", "points"]
    async with http_server(RecallModel()) as client:
        job_id = (await submit(client, ARCHIVE, output=outputs))["id"]
        await ended(client, job_id)
        zips = {
            form: zipfile.ZipFile(
                io.BytesIO(
                    (
                        await client.get(f"/v1/sequences/{job_id}/result", params={"format": form})
                    ).content
                )
            )
            for form in ("png16", "png16mm", "pfm")
        }
        for path, form, name in (
            ("disparity.png", "png16", "disparity/0003.png"),
            ("depth.png", "png16", "depth/0003.png"),
            ("depth.mm.png", "png16mm", "depth/0003.png"),
            ("depth.pfm", "pfm", "depth/0003.pfm"),
            ("sigma.pfm", "pfm", "sigma/0003.pfm"),
            ("confidence.png", "png16", "confidence/0003.png"),
            ("left", "png16", "left/0003.png"),
            ("points.ply", "png16", "points/0003.ply"),
        ):
            answer = await client.get(f"/v1/sequences/{job_id}/frames/3/{path}")
            assert answer.content == zips[form].read(name), path
    left = cv2.imdecode(np.frombuffer(zips["pfm"].read("left/0003.png"), np.uint8), 1)
    assert left is not None
    np.testing.assert_array_equal(left[..., ::-1], make_frames(12)[3].left)


async def test_a_frame_without_a_map_says_why_and_other_wrong_requests_do_too() -> None:
    frames = make_frames(3)
    frames[1].left[0, 0] = NOT_FINITE
    async with http_server(RecallModel()) as client:
        job_id = (await submit(client, zip_bytes(sequence_files(frames))))["id"]
        await ended(client, job_id)
        lost = decode_frame((await client.get(f"/v1/sequences/{job_id}/frames/1")).content, RIG)
        assert lost.disparity is None
        assert "not finite" in str(lost.record.error)
        for path, status, reason, says in (
            ("1/disparity.png", 404, "SEQUENCE_UNKNOWN", "not finite"),
            ("3", 404, "SEQUENCE_UNKNOWN", "3 frames"),
            ("-1", 400, "BAD_SHAPE", "index"),
            ("0/sigma.png", 400, "BAD_SHAPE", "output=sigma"),
            ("0/secret.png", 400, "BAD_SHAPE", "disparity.png"),
        ):
            answer = await client.get(f"/v1/sequences/{job_id}/frames/{path}")
            assert (answer.status_code, reason_of(answer)) == (status, reason), path
            assert says in answer.text
        tum = await client.get(f"/v1/sequences/{job_id}/result", params={"format": "tum"})
        assert (tum.status_code, reason_of(tum)) == (400, "BAD_SHAPE")
        assert "output=left" in tum.text


async def test_a_cancelled_job_keeps_what_is_done_and_the_next_one_runs() -> None:
    model = StopsAt(9)  # of nine stepped frames, four may wait to be counted
    async with http_server(model) as client:
        job_id = (await submit(client, ARCHIVE))["id"]
        waiting = (await submit(client, ARCHIVE))["id"]
        after = (await submit(client, ARCHIVE))["id"]
        await lines(client, job_id, after=2, wait_s=20)
        cancelled = [(await client.post(f"/v1/sequences/{waiting}/cancel")).json()]
        asked = asyncio.create_task(client.post(f"/v1/sequences/{job_id}/cancel"))
        # It is cancelled at once, and ends with the step that is in the model.
        await ended(client, job_id)
        model.let_go()
        cancelled.append((await asked).json())
        assert (await ended(client, after))["state"] == "done"
        maps = await disparities(client, job_id)
        whole = await disparities(client, after)
        again = (await client.post(f"/v1/sequences/{after}/cancel")).json()
        nothing = await client.get(f"/v1/sequences/{waiting}/result")
    assert [job["state"] for job in cancelled] == ["cancelled", "cancelled"]
    assert len(maps) == cancelled[1]["frames_done"] >= 3
    np.testing.assert_array_equal(maps, whole[: len(maps)])
    assert again["state"] == "done"
    assert (nothing.status_code, reason_of(nothing)) == (409, "SEQUENCE_NOT_DONE")


async def test_a_cancelled_job_stays_cancelled_through_a_restart(tmp_path: Any) -> None:
    async with http_server(RecallModel(), batch__directory=tmp_path) as client:
        job_id = (await submit(client, ARCHIVE))["id"]
        job = (await client.post(f"/v1/sequences/{job_id}/cancel")).json()
    async with http_server(RecallModel(), batch__directory=tmp_path) as client:
        kept = (await client.get(f"/v1/sequences/{job_id}")).json()
    assert kept == job
