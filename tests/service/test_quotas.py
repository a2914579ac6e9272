"""What one principal may hold: memory, work, requests and disk. Another one is not affected."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import grpc
import pytest

from tests.support.frames import RIG, frame_message, make_frame, open_message
from tests.support.http import ZIP, ended, pair_form, reason_of, submit
from tests.support.models import RecallModel
from tests.support.polling import eventually
from tests.support.sequences import make_frames, sequence_files, zip_bytes
from tests.support.server import RawCall, running_server
from tests.support.status import reason_of as reason_over_grpc
from tests.support.tokens import TokenFile, http_as, stub
from vergence_proto.types import StereoRig
from vergence_proto.v1 import depth_pb2 as pb
from vergence_service.app.server import Running

LARGE = StereoRig.from_rectified(replace(RIG, width=192, height=160))  # needs more than half a MiB


@asynccontextmanager
async def guarded(
    tmp_path: Path, model: RecallModel | None = None, **settings: Any
) -> AsyncIterator[tuple[Running, TokenFile]]:
    file = TokenFile(tmp_path / "tokens.toml", "ana", "ben")
    async with running_server(
        model or RecallModel(),
        security__tokens=file.path,
        batch__directory=tmp_path / "jobs",
        **settings,
    ) as server:
        yield server, file


async def opened(calls: Any, file: TokenFile, name: str, rig: StereoRig | None = None) -> RawCall:
    call = RawCall(calls.StreamDepth(metadata=tuple(file.shown(name).items())))
    await call.ask(open_message(rig=rig))
    return call


async def refusal(calls: Any, file: TokenFile, name: str, rig: StereoRig | None = None) -> str:
    with pytest.raises(grpc.aio.AioRpcError) as failure:
        await opened(calls, file, name, rig)
    assert reason_over_grpc(failure.value) == "QUOTA"
    return failure.value.details() or ""


async def test_large_streams_of_one_principal_use_up_its_memory(tmp_path: Path) -> None:
    async with guarded(tmp_path, limits__state_mib=1) as (server, file), stub(server) as calls:
        first = await opened(calls, file, "ana", LARGE)
        why = await refusal(calls, file, "ana", LARGE)
        assert "192x160" in why
        assert "limits.state_mib" in why
        await opened(calls, file, "ana")  # a small one fits
        await opened(calls, file, "ben", LARGE)
        await end(first)
        await opened(calls, file, "ana", LARGE)


async def test_a_principal_whose_streams_take_much_gets_no_further_one(tmp_path: Path) -> None:
    # A frame of 64x48 in five seconds is 0.0012 megapixels a second.
    limit = 0.003
    async with (
        guarded(tmp_path, limits__megapixels_per_s=limit) as (server, file),
        stub(server) as calls,
    ):
        busy = await opened(calls, file, "ana")
        await busy.ask(frame_message(make_frame(1)))
        await opened(calls, file, "ana")
        for frame_id in (2, 3):
            await busy.ask(frame_message(make_frame(frame_id)))
        why = await refusal(calls, file, "ana")
        assert "limits.megapixels_per_s" in why
        assert "64x48" in why
        await opened(calls, file, "ben")


async def test_the_open_requests_of_one_principal_are_counted_on_all_ports(tmp_path: Path) -> None:
    async with (
        guarded(tmp_path, limits__requests=2) as (server, file),
        stub(server) as calls,
        http_as(server, file.shown("ana")) as ana,
        http_as(server, file.shown("ben")) as ben,
    ):
        one, _ = [await opened(calls, file, "ana") for _ in range(2)]
        assert "limits.requests" in await refusal(calls, file, "ana")
        answer = await ana.get("/v1/sequences")
        assert (answer.status_code, reason_of(answer)) == (429, "QUOTA")
        assert (await ben.get("/v1/sequences")).status_code == 200
        await end(one)
        assert (await ana.get("/v1/sequences")).status_code == 200


async def test_what_one_principal_keeps_leaves_disk_to_others(tmp_path: Path) -> None:
    archive = zip_bytes(sequence_files(make_frames(2)))
    large = {"Tus-Resumable": "1.0.0", "Upload-Length": str((1 << 20) - 100)}
    async with (
        guarded(tmp_path, limits__sequences_mib=1) as (server, file),
        http_as(server, file.shown("ana")) as ana,
        http_as(server, file.shown("ben")) as ben,
    ):
        announced = await ana.post("/v1/uploads", headers=large)
        assert announced.status_code == 201
        for answer in (
            await ana.post("/v1/uploads", headers=large),
            await ana.post("/v1/sequences", content=archive, headers=ZIP),
        ):
            assert (answer.status_code, reason_of(answer)) == (429, "QUOTA")
            assert "limits.sequences_mib" in answer.json()["detail"]
        await submit(ben, archive)
        await ana.delete(announced.headers["location"], headers={"Tus-Resumable": "1.0.0"})
        await submit(ana, archive)
        # The job and its result count too.
        assert (await ana.post("/v1/uploads", headers=large)).status_code == 429


async def test_the_pairs_of_one_principal_leave_places_to_others(tmp_path: Path) -> None:
    model = RecallModel()
    async with (
        guarded(tmp_path, model, limits__pairs=2) as (server, file),
        http_as(server, file.shown("ana")) as ana,
        http_as(server, file.shown("ben")) as ben,
    ):
        with model.busy():
            first = asyncio.create_task(ana.post("/v1/pairs", files=pair_form()))
            await asyncio.to_thread(model.wait_until_entered)
            refused = await ana.post("/v1/pairs", files=pair_form())
            assert (refused.status_code, reason_of(refused)) == (429, "QUOTA")
            his = asyncio.create_task(ben.post("/v1/pairs", files=pair_form()))
            metric = server.engine.metrics.pairs
            await eventually(lambda: next(iter(metric.collect())).samples[0].value == 2)
        assert [(await each).status_code for each in (first, his)] == [200, 200]


async def test_the_jobs_of_principals_run_in_turn(tmp_path: Path) -> None:
    archive, model = zip_bytes(sequence_files(make_frames(2))), RecallModel()
    async with (
        guarded(tmp_path, model) as (server, file),
        http_as(server, file.shown("ana")) as ana,
        http_as(server, file.shown("ben")) as ben,
    ):
        with model.busy():
            hers = [await submit(ana, archive) for _ in range(3)]
            await asyncio.to_thread(model.wait_until_entered)
            his = await submit(ben, archive)
            ahead = [
                (await who.get(f"/v1/sequences/{job['id']}")).json()["ahead"]
                for who, job in ((ana, hers[1]), (ana, hers[2]), (ben, his))
            ]
        assert ahead == [2, 3, 1]
        assert (await ended(ben, his["id"]))["state"] == "done"


async def end(call: RawCall) -> None:
    await call.send(pb.StreamDepthRequest(end=pb.End()))
    while await call.receive() is not None:
        pass
