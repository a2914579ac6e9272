"""Whole sequences over HTTP give the same maps as a live stream of the same frames."""

import asyncio
import io
import json
import zipfile
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import av
import cv2
import httpx
import numpy as np
import pytest

from tests.support.frames import RIG, frame_message
from tests.support.http import (
    ZIP,
    as_kept,
    disparities,
    disparities_in,
    ended,
    files_below,
    http_server,
    http_to,
    reason_of,
    submit,
)
from tests.support.models import NOT_FINITE, RecallModel
from tests.support.sequences import (
    CALIBRATION,
    make_frames,
    png,
    pose_numbers,
    sequence_files,
    tar_bytes,
    zip_bytes,
)
from tests.support.server import raw_stream, running_server
from vergence_proto import codec
from vergence_proto.datasets import read_disparity_png, read_pfm
from vergence_proto.errors import ErrorCode
from vergence_proto.types import Plane
from vergence_service.inference.model import Step, StepResult
from vergence_service.transports.http.errors import HTTP_STATUS
from vergence_service.transports.http.pairs import BEYOND_HEADER, RANGE_HEADER

FRAMES = make_frames(6)
ARCHIVE = zip_bytes(sequence_files(FRAMES))


def test_every_error_code_has_an_http_status() -> None:
    assert set(HTTP_STATUS) == set(ErrorCode)


def form_files(*, nested: bool = False) -> list[tuple[str, bytes]]:
    poses: list[Any] = [pose_numbers(frame) for frame in FRAMES]
    if nested:
        poses = [[*np.reshape(pose, (3, 4)).tolist(), [0, 0, 0, 1]] for pose in poses]
    sequence = json.dumps({"calibration": CALIBRATION, "poses": poses})
    return [
        ("sequence", sequence.encode("utf-8-sig" if nested else "utf-8")),
        *(("left", png(frame.left)) for frame in FRAMES),
        *(("right", png(frame.right)) for frame in FRAMES),
    ]


UPLOADS: dict[str, dict[str, Any]] = {
    "zip": {"content": ARCHIVE, "headers": ZIP},
    "zip in a folder": {
        "content": zip_bytes((f"room/{name}", file) for name, file in sequence_files(FRAMES)),
        "headers": ZIP,
    },
    "tar": {
        "content": tar_bytes(sequence_files(FRAMES), "w"),
        "headers": {"Content-Type": "application/x-tar"},
    },
    "tar.gz": {
        "content": tar_bytes(sequence_files(FRAMES), "w:gz"),
        "headers": {"Content-Type": "application/gzip"},
    },
    "tar.xz as bytes": {
        "content": tar_bytes(sequence_files(FRAMES), "w:xz"),
        "headers": {"Content-Type": "application/octet-stream"},
    },
    "archive in a form": {"files": {"archive": ARCHIVE}},
    "frames in a form": {"files": form_files()},
    "matrices in a form with a byte order mark": {"files": form_files(nested=True)},
}


async def test_a_sequence_gets_what_its_frames_get_over_grpc_however_it_is_packed() -> None:
    async with running_server(RecallModel()) as server, http_to(server) as client:
        async with raw_stream(server) as call:
            answers = [(await call.ask(frame_message(frame))).disparity for frame in FRAMES]
            streamed = [codec.disparity_from_proto(each, RIG).disparity_px for each in answers]
        for packed, upload in UPLOADS.items():
            query: dict[str, str | bool] = {"wait": True, "format": "npz"}
            answer = await client.post("/v1/sequences", params=query, **upload)
            assert answer.status_code == 200, (packed, answer.text)
            np.testing.assert_array_equal(disparities_in(answer.content), as_kept(streamed), packed)


async def test_a_job_reports_how_far_it_is_and_ends_with_its_result() -> None:
    model = RecallModel()
    async with http_server(model) as client:
        with model.busy():
            job = await submit(client, ARCHIVE)
            assert (job["frames"], job["source"]) == (6, "vergence:")
            async with client.stream("GET", f"/v1/sequences/{job['id']}/events") as events:
                progress_seen = []
                async for line in events.aiter_lines():
                    if line.startswith("data: "):
                        progress_seen.append(json.loads(line.removeprefix("data: ")))
                        model.let_go()
        done = await ended(client, job["id"])
    assert progress_seen[0]["state"] in ("queued", "running")
    assert progress_seen[-1] == done
    assert (done["state"], done["frames_done"]) == ("done", 6)


async def test_results_come_in_every_format_and_output() -> None:
    async with http_server(RecallModel()) as client:
        job = await submit(client, ARCHIVE, output=["disparity", "depth", "confidence", "sigma"])
        await ended(client, job["id"])
        exact = await disparities(client, job["id"])
        zips = {
            form: await client.get(f"/v1/sequences/{job['id']}/result", params={"format": form})
            for form in ("png16", "pfm", "npz", "mp4")
        }
    depths = [RIG.depth_from_disparity(each) for each in exact]
    with zipfile.ZipFile(io.BytesIO(zips["npz"].content)) as file:
        arrays = dict(np.load(io.BytesIO(file.read("0005.npz"))))
    np.testing.assert_array_equal(arrays["depth"], depths[5])
    assert {*arrays} == {"disparity", "depth", "confidence", "sigma"}
    for form, extension in (("png16", "png"), ("pfm", "pfm")):
        with zipfile.ZipFile(io.BytesIO(zips[form].content)) as file:
            assert file.testzip() is None
            assert json.loads(file.read("rig.json"))["baseline_m"] == RIG.baseline_m
            for name, planes in (("disparity", exact), ("depth", depths)):
                for index, plane in enumerate(planes):
                    content = file.read(f"{name}/{index:04d}.{extension}")
                    np.testing.assert_allclose(
                        read_back(content, extension), plane, atol=0 if form == "pfm" else 1 / 512
                    )
            stored = np.frombuffer(file.read("confidence/0005.png"), np.uint8)
            confidence = cv2.imdecode(stored, cv2.IMREAD_UNCHANGED)
            np.testing.assert_array_equal(confidence, arrays["confidence"])
            sigma_px = read_back(file.read(f"sigma/0005.{extension}"), extension)
            np.testing.assert_allclose(sigma_px, np.minimum(arrays["sigma"], 65535 / 256), 0, 1e-2)
    assert zips["mp4"].headers["Content-Type"] == "video/mp4"
    with av.open(io.BytesIO(zips["mp4"].content), "r") as film:
        assert film.streams.video[0].codec_context.name == "h264"  # every browser plays it
        assert sum(1 for _ in film.decode(video=0)) == len(exact)


def read_back(content: bytes, extension: str) -> Plane:
    with TemporaryDirectory() as scratch:
        path = Path(scratch) / f"plane.{extension}"
        path.write_bytes(content)
        return read_disparity_png(path) if extension == "png" else read_pfm(path)


async def test_accuracy_is_progress_seen_where_the_archive_has_the_truth() -> None:
    async with http_server(RecallModel()) as client:
        asked = await submit(client, ARCHIVE, metrics=True)
        unasked = await submit(client, ARCHIVE)
        accuracy = (await ended(client, asked["id"]))["accuracy"]
        maps = await disparities(client, asked["id"])
        assert (await ended(client, unasked["id"]))["accuracy"] is None
    # It is measured before the maps are rounded.
    epe_px = np.mean([np.abs(each - 8) for each in maps])
    assert accuracy["epe_px"] == pytest.approx(epe_px, abs=1 / 128)
    assert accuracy["n"] == 6 * RIG.width * RIG.height


async def test_iterations_are_those_asked_for() -> None:
    async with http_server(IterationsModel()) as client:
        job = await submit(client, zip_bytes(sequence_files(FRAMES[:2])))
        await ended(client, job["id"])
        assert [float(each[0, 0]) for each in await disparities(client, job["id"])] == [4, 1]
        pair = {"left.png": png(FRAMES[0].left), "right.png": png(FRAMES[0].right)}
        files = {**pair, "calib.json": json.dumps(CALIBRATION).encode()}
        job = await submit(client, zip_bytes(files.items()), iterations=1)
        await ended(client, job["id"])
        assert [float(each[0, 0]) for each in await disparities(client, job["id"])] == [1]
        refused = await client.post(
            "/v1/sequences", params={"iterations": 4}, content=ARCHIVE, headers=ZIP
        )
        assert reason_of(refused) == "BAD_SHAPE"
        assert "quality=best" in refused.json()["detail"]


class IterationsModel(RecallModel):
    """Its disparity is the number of iterations."""

    def step(self, steps: Sequence[Step]) -> list[StepResult]:
        results = super().step(steps)
        for row, result in zip(steps, results, strict=True):
            result.offset_px[:] = row.iterations
        return results


async def test_a_deleted_job_stops_and_leaves_nothing_behind(tmp_path: Path) -> None:
    model = RecallModel()
    async with http_server(model, batch__directory=tmp_path) as client:
        with model.busy():
            running = await submit(client, ARCHIVE)
            waiting = await submit(client, ARCHIVE)
            await asyncio.to_thread(model.wait_until_entered)
            assert waiting["ahead"] == 1
            for job in (running, waiting):
                assert (await client.delete(f"/v1/sequences/{job['id']}")).status_code == 204
                answer = await client.get(f"/v1/sequences/{job['id']}")
                assert (answer.status_code, reason_of(answer)) == (404, "SEQUENCE_UNKNOWN")
        after = await submit(client, ARCHIVE)
        assert (await ended(client, after["id"]))["state"] == "done"
        assert (await client.delete(f"/v1/sequences/{after['id']}")).status_code == 204
        assert not files_below(tmp_path / "jobs")


async def test_a_sequence_that_fails_says_at_what_keeps_what_it_has_and_the_next_one_runs() -> None:
    frames = make_frames(4)
    frames[2].left[0, 0] = NOT_FINITE
    first = make_frames(2)
    first[0].left[0, 0] = NOT_FINITE
    async with http_server(RecallModel()) as client:
        job = await submit(client, zip_bytes(sequence_files(frames)), on_error="fail")
        failed = await ended(client, job["id"])
        assert (failed["state"], failed["reason"]) == ("failed", "NON_FINITE")
        assert failed["frames_done"] == len(await disparities(client, job["id"])) == 2
        job = await submit(client, zip_bytes(sequence_files(first)), on_error="fail")
        await ended(client, job["id"])
        answer = await client.get(f"/v1/sequences/{job['id']}/result")
        assert (answer.status_code, reason_of(answer)) == (409, "SEQUENCE_NOT_DONE")
        assert "NON_FINITE" in answer.json()["detail"]
        assert (await ended(client, (await submit(client, ARCHIVE))["id"]))["state"] == "done"


async def test_a_frame_whose_step_fails_is_left_out_and_the_next_one_starts_cold() -> None:
    frames = make_frames(4)
    frames[2].left[0, 0] = NOT_FINITE
    async with http_server(RecallModel()) as client:
        job = await ended(client, (await submit(client, zip_bytes(sequence_files(frames))))["id"])
        records = await records_of(client, job["id"])
    assert (job["state"], job["frames_failed"], job["cold_frames"]) == ("done", 1, 2)
    assert "not finite" in records[2]["error"]
    assert [each["origin"] for each in records] == [
        "cold start",
        "warm",
        None,
        "result was not finite",
    ]


async def records_of(client: httpx.AsyncClient, job_id: str) -> list[dict[str, Any]]:
    answer = await client.get(f"/v1/sequences/{job_id}/result", params={"format": "npz"})
    with zipfile.ZipFile(io.BytesIO(answer.content)) as file:
        return [json.loads(line) for line in file.read("frames.jsonl").splitlines()]


CUT_JPEG = cv2.imencode(".jpg", FRAMES[0].left)[1].tobytes()[:300]


async def test_bad_images_cost_their_own_frames_and_three_lines_say_why() -> None:
    files = dict(sequence_files(make_frames(30)))
    files["frame_0003_left.jpg"] = CUT_JPEG
    del files["frame_0003_left.png"], files["frame_0017_right.png"]
    files["frame_0009_left.png"] = png(FRAMES[0].left[:20])
    async with http_server(RecallModel()) as client:
        job = await submit(client, zip_bytes(files.items()), metrics=True)
        assert [each["kind"] for each in job["warnings"]] == ["unreadable"]
        done = await ended(client, job["id"])
        maps = await disparities(client, job["id"])
        records = await records_of(client, job["id"])
        strict = await client.post(
            "/v1/sequences",
            params={"on_error": "fail"},
            content=zip_bytes(files.items()),
            headers=ZIP,
        )
    assert (done["state"], done["frames_done"], done["frames_failed"]) == ("done", 30, 3)
    assert len(maps) == 27
    errors = {each["index"]: each["error"] for each in records if each["error"]}
    assert {*errors} == {3, 9, 17}
    for index, words in ((3, "cut short"), (9, "expected 64x48"), (17, "not found")):
        assert words in errors[index], errors
        assert f"frame_{index:04d}" in errors[index]
    assert [each["index"] for each in records] == [*range(30)]
    assert reason_of(strict) == "BAD_SEQUENCE"


async def test_a_job_says_before_it_runs_what_will_be_slow_or_is_guessed() -> None:
    files = dict(sequence_files(FRAMES))
    blind = zip_bytes((name, file) for name, file in files.items() if name != "poses.txt")
    unknown = {"calib.json": json.dumps({**CALIBRATION, "baseline_m": None}).encode()}
    model = RecallModel()
    async with http_server(model) as client:
        assert (await submit(client, ARCHIVE))["warnings"] == []
        job = await ended(client, (await submit(client, blind))["id"])
        with model.busy():
            others = [await submit(client, ARCHIVE) for _ in range(3)]
            queued = (await client.get(f"/v1/sequences/{others[-1]['id']}")).json()
        guessed = await submit(client, zip_bytes({**files, **unknown}.items()))
    assert [each["kind"] for each in job["warnings"]] == ["no_poses"]
    assert job["cold_frames"] == 6
    assert [each["kind"] for each in guessed["warnings"]] == ["guessed_units"]
    assert queued["state"] == "queued"
    assert queued["eta_s"] > 0


async def test_a_result_before_its_time_says_so() -> None:
    model = RecallModel()
    async with http_server(model) as client:
        with model.busy():
            job = await submit(client, ARCHIVE)
            answer = await client.get(f"/v1/sequences/{job['id']}/result")
            assert (answer.status_code, reason_of(answer)) == (409, "SEQUENCE_NOT_DONE")


async def test_a_full_queue_says_when_to_come_back_and_takes_the_next_one_then() -> None:
    model = RecallModel()
    async with http_server(model, batch__waiting=1) as client:
        with model.busy():
            job = await submit(client, ARCHIVE)
            answer = await client.post("/v1/sequences", content=ARCHIVE, headers=ZIP)
            assert (answer.status_code, reason_of(answer)) == (429, "QUEUE_FULL")
            assert int(answer.headers["Retry-After"]) >= 1
        await ended(client, job["id"])
        await submit(client, ARCHIVE)


async def test_a_client_that_has_its_share_of_the_queue_leaves_the_rest_to_others() -> None:
    model = RecallModel()
    async with running_server(model, batch__waiting_per_client=1) as server:
        elsewhere = httpx.AsyncHTTPTransport(local_address="127.0.0.2")
        base = f"http://{server.http_address}"
        async with (
            http_to(server) as client,
            httpx.AsyncClient(transport=elsewhere, base_url=base) as other,
        ):
            with model.busy():
                mine = await submit(client, ARCHIVE)
                answer = await client.post("/v1/sequences", content=ARCHIVE, headers=ZIP)
                assert (answer.status_code, reason_of(answer)) == (429, "QUOTA")
                assert int(answer.headers["Retry-After"]) >= 1
                theirs = await submit(other, ARCHIVE)
            for job in (mine, theirs):
                assert (await ended(client, job["id"]))["state"] == "done"
            await submit(client, ARCHIVE)


async def test_a_pair_is_answered_at_once() -> None:
    frame = FRAMES[0]
    files = {"left": png(frame.left), "right": png(frame.right)}
    async with running_server(RecallModel()) as server, http_to(server) as client:
        async with raw_stream(server) as call:
            streamed = (await call.ask(frame_message(frame))).disparity
        exact = await client.post("/v1/pairs", params={"format": "npy"}, files=files)
        rounded = await client.post("/v1/pairs", files=files)
        query: dict[str, str | float] = {"format": "npy", "output": "depth"}
        query |= {"fx_px": RIG.fx, "baseline_m": RIG.baseline_m}
        depth = await client.post("/v1/pairs", params=query, files=files)
        sure = await client.post("/v1/pairs", params={"output": "confidence"}, files=files)
    expected = codec.disparity_from_proto(streamed, RIG)
    np.testing.assert_array_equal(np.load(io.BytesIO(exact.content)), expected.disparity_px)
    np.testing.assert_array_equal(np.load(io.BytesIO(depth.content)), expected.depth_m)
    assert rounded.headers["Content-Type"] == "image/png"
    stored = cv2.imdecode(np.frombuffer(rounded.content, np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(stored, np.rint(expected.disparity_px * 256))
    assert rounded.headers[BEYOND_HEADER] == "0"
    assert float(rounded.headers[RANGE_HEADER]) == expected.max_disparity_px == 64
    confidence = cv2.imdecode(np.frombuffer(sure.content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert confidence is not None
    assert confidence.dtype == np.uint8
    assert confidence.shape == (RIG.height, RIG.width)
    assert confidence.any()


async def test_a_pair_comes_with_every_map_in_one_archive() -> None:
    files = {"left": png(FRAMES[0].left), "right": png(FRAMES[0].right)}
    rig: dict[str, str | float] = {"fx_px": RIG.fx, "baseline_m": RIG.baseline_m}
    async with http_server(RecallModel()) as client:

        async def ask(**query: str) -> bytes:
            answer = await client.post("/v1/pairs", params={**rig, **query}, files=files)
            assert answer.status_code == 200, answer.text
            return answer.content

        with np.load(io.BytesIO(await ask(format="npz"))) as arrays:
            maps = dict(arrays)
        for name, values in maps.items():
            alone = np.load(io.BytesIO(await ask(format="npy", output=name)))
            np.testing.assert_array_equal(alone, values)
        stored = {
            (form, name): cv2.imdecode(
                np.frombuffer(await ask(format=form, output=name), np.uint8), cv2.IMREAD_UNCHANGED
            )
            for form, name in (("png16", "sigma"), ("png16", "confidence"), ("png16mm", "depth"))
        }
        refused = await client.post("/v1/pairs", params={"format": "png16mm"}, files=files)
    assert {*maps} == {"disparity", "depth", "confidence", "sigma"}
    sigma, confidence, depth_mm = stored.values()
    np.testing.assert_array_equal(sigma, np.rint(np.minimum(maps["sigma"], 255.998) * 256))
    np.testing.assert_array_equal(confidence, maps["confidence"])
    expected_mm = np.rint(np.nan_to_num(maps["depth"]) * 1000)
    np.testing.assert_array_equal(depth_mm, np.where(expected_mm < 65536, expected_mm, 0))
    assert reason_of(refused) == "BAD_SHAPE"


async def test_a_depth_that_a_png_cannot_hold_has_no_value_in_it() -> None:
    files = {"left": png(FRAMES[0].left), "right": png(FRAMES[0].right)}
    query: dict[str, str | float] = {"output": "depth", "fx_px": 4000.0, "baseline_m": 1.0}
    async with http_server(RecallModel()) as client:
        coarse = await client.post("/v1/pairs", params=query, files=files)
        exact = await client.post("/v1/pairs", params={**query, "format": "npy"}, files=files)
    depth_m = np.load(io.BytesIO(exact.content))
    beyond = depth_m > 255.998
    assert beyond.any()
    stored = cv2.imdecode(np.frombuffer(coarse.content, np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(stored == 0, beyond | np.isnan(depth_m))
    assert int(coarse.headers[BEYOND_HEADER]) == beyond.sum()


async def test_health_metrics_and_schema_answer() -> None:
    async with http_server(RecallModel()) as client:
        answers: dict[str, httpx.Response] = {
            path: await client.get(path) for path in ("/healthz", "/readyz", "/openapi.json")
        }
    assert {path: answer.status_code for path, answer in answers.items()} == dict.fromkeys(
        answers, 200
    )
    assert "/v1/sequences" in answers["/openapi.json"].json()["paths"]
