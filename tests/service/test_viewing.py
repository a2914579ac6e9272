"""What the administrator's page shows of a stream is what the stream's client gets."""

import asyncio
import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.support.frames import RIG, frame_message, make_frame, open_message
from tests.support.http import admin_of, ended, reason_of, submit
from tests.support.models import RecallModel
from tests.support.polling import eventually
from tests.support.sequences import make_frames, sequence_files, zip_bytes
from tests.support.server import RawCall, raw_stream, running_server
from tests.support.tokens import TokenFile, http_as, stub
from vergence_proto import codec
from vergence_proto.codec.images import decode_image
from vergence_proto.types import StereoFrame, StereoRig

RIGS = {
    "as it is": RIG,
    "principal points apart": replace(RIG, cx_right=37.5),
    "the left one to the right": replace(RIG, cx_left=27.5),
    "wider than a view": replace(RIG, width=1000, height=40, cx_left=500.0, cx_right=500.0),
}


def planes_of(view: bytes) -> tuple[dict[str, Any], NDArray[np.uint8], list[NDArray[np.float32]]]:
    """The header, the image as RGB, and disparity and sigma in pixels."""
    (text_bytes,) = struct.unpack_from("<I", view)
    header = json.loads(view[4 : 4 + text_bytes])
    jpeg_at = 4 + text_bytes
    planes_at = jpeg_at + header["jpeg_bytes"]
    image = decode_image(view[jpeg_at:planes_at])
    stored = np.frombuffer(view, "<u2", offset=planes_at)
    planes = stored.reshape(2, header["height"], header["width"]) / np.float32(64)
    planes[planes == 0] = np.nan
    return header, image, [*planes.astype(np.float32)]


def smooth_frame(rig: Any) -> StereoFrame:
    """A picture that JPEG and a reduction change little: a ramp along the rows."""
    ramp = np.linspace(20, 230, rig.width).astype(np.uint8)
    image = np.broadcast_to(ramp[None, :, None], (rig.height, rig.width, 3)).copy()
    return replace(make_frame(1, rig=rig), left=image, right=image)


@pytest.mark.parametrize("rig", RIGS.values(), ids=RIGS)
async def test_a_view_is_the_next_map_and_its_image(rig: Any) -> None:
    async with (
        running_server(RecallModel()) as server,
        admin_of(server) as admin,
        raw_stream(server, "mine", rig=StereoRig.from_rectified(rig), sigma=True) as call,
    ):
        view = asyncio.create_task(admin.get("/v1/admin/streams/local/mine/view"))
        await eventually(lambda: server.engine.viewers.count == 1)
        frame = smooth_frame(rig)
        answer = (await call.ask(frame_message(frame))).disparity
        shown = await view
        assert server.engine.viewers.count == 0
    assert shown.status_code == 200
    header, image, (disparity_px, sigma_px) = planes_of(shown.content)
    every = header["every"]
    assert (header["frame_id"], header["origin"], header["step_count"]) == (1, "cold_start", 1)
    assert every == -(-rig.width // 480)
    received = codec.received_planes_from_proto(answer, rig)
    for plane, expected in zip(
        (disparity_px, sigma_px), (received.disparity_px, received.sigma_px), strict=True
    ):
        assert expected is not None
        np.testing.assert_allclose(plane, expected[::every, ::every], atol=1 / 128, equal_nan=True)
    np.testing.assert_allclose(
        image.astype(float), frame.left[::every, ::every].astype(float), atol=4
    )


async def test_who_looks_leaves_nothing_behind_and_others_are_told() -> None:
    async with (
        running_server(RecallModel()) as server,
        admin_of(server) as admin,
        raw_stream(server, "mine") as call,
    ):
        async with admin_of(server) as hasty:
            left = asyncio.create_task(hasty.get("/v1/admin/streams/local/mine/view"))
            await eventually(lambda: server.engine.viewers.count == 1)
            left.cancel()
            await asyncio.wait([left])
        await call.ask(frame_message(make_frame(1)))
        await eventually(lambda: server.engine.viewers.count == 0)
        unknown = await admin.get("/v1/admin/streams/local/none/view")
        assert (unknown.status_code, reason_of(unknown)) == (404, "STREAM_UNKNOWN")
    async with (
        running_server(RecallModel(), admin__images=False) as server,
        admin_of(server) as admin,
        raw_stream(server, "mine"),
    ):
        refused = await admin.get("/v1/admin/streams/local/mine/view")
        assert (refused.status_code, reason_of(refused)) == (403, "FORBIDDEN")
        assert "admin.images" in refused.text


async def test_with_tokens_administrators_alone_see_streams_and_fetch_results(
    tmp_path: Path,
) -> None:
    file = TokenFile(tmp_path / "tokens", "ana", admins=("root",))
    async with (
        running_server(RecallModel(), security__tokens=file.path) as server,
        admin_of(server) as stranger,
        admin_of(server, **file.shown("ana")) as ana,
        admin_of(server, **file.shown("root")) as root,
        http_as(server, file.shown("ana")) as hers,
        stub(server) as calls,
    ):
        call = RawCall(calls.StreamDepth(metadata=tuple(file.shown("ana").items())))
        await call.ask(open_message("hers"))
        path = "/v1/admin/streams/ana/hers/view"
        assert (await stranger.get(path)).status_code == 401
        assert (await ana.get(path)).status_code == 403
        view = asyncio.create_task(root.get(path))
        await eventually(lambda: server.engine.viewers.count == 1)
        await call.ask(frame_message(make_frame(1)))
        assert (await view).status_code == 200

        archive = zip_bytes(sequence_files(make_frames(2)))
        job = await submit(hers, archive, name="drive 17")
        await ended(hers, job["id"])
        [row] = (await root.get("/v1/admin/state")).json()["sequences"]
        assert (row["job_id"], row["principal"], row["name"]) == (job["id"], "ana", "drive 17")
        assert (row["state"], row["frames"], row["frames_done"]) == ("done", 2, 2)
        path = f"/v1/admin/sequences/{job['id']}/result?format=npz"
        expected = await hers.get(f"/v1/sequences/{job['id']}/result?format=npz")
        assert (await root.get(path)).content == expected.content
        assert (await ana.get(path)).status_code == 403


async def test_without_tokens_a_job_shows_its_progress_and_keeps_its_secret() -> None:
    async with running_server(RecallModel()) as server, admin_of(server) as admin:
        async with http_as(server, {}) as client:
            job = await submit(client, zip_bytes(sequence_files(make_frames(2))))
            await ended(client, job["id"])
        state = await admin.get("/v1/admin/state")
        [row] = state.json()["sequences"]
        assert (row["job_id"], row["state"], row["frames_done"]) == ("", "done", 2)
        assert job["id"] not in state.text
