"""An accepted sequence is done, whatever happens to the process in between."""

import asyncio
import io
import json
import re
import socket
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import httpx
import numpy as np
import pytest
from rich.console import Console

from tests.support.http import (
    disparities,
    ended,
    files_below,
    http_at,
    http_server,
    metrics_of,
    state_of,
    submit,
)
from tests.support.models import RecallModel
from tests.support.polling import eventually
from tests.support.sequences import make_frames, sequence_files, write_sequence, zip_bytes
from tests.support.server import PATIENCE_S
from vergence.cli.batch import batch

REPOSITORY = Path(__file__).parents[2]
ARCHIVES = [zip_bytes(sequence_files(make_frames(5, brightness=10 * n))) for n in range(1, 21)]


@asynccontextmanager
async def killed_server(
    directory: Path, *, step_s: float = 0.0, port: int = 0
) -> AsyncIterator[httpx.AsyncClient]:
    """A server in a process of its own, which ends by SIGKILL."""
    process = await asyncio.create_subprocess_exec(
        *(
            sys.executable,
            "-m",
            "tests.support.batch_server",
            str(directory),
            str(step_s),
            str(port),
        ),
        cwd=REPOSITORY,
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
    )
    try:
        assert process.stdout is not None
        address = (await process.stdout.readline()).decode().strip()
        assert address, "the server did not start"
        async with http_at(*address.split()) as client:
            yield client
    finally:
        process.kill()
        await process.wait()


@pytest.mark.slow
async def test_a_killed_server_finishes_all_that_it_accepted(tmp_path: Path) -> None:
    # Steps are so slow that the server is killed in the middle of a sequence.
    async with killed_server(tmp_path, step_s=0.04) as client:
        job_ids = [(await submit(client, archive))["id"] for archive in ARCHIVES]
        await ended(client, job_ids[2])
        before = {each: await state_of(client, each) for each in job_ids}
    assert "queued" in before.values(), "the kill came too late to show anything"
    (tmp_path / "incoming" / "half").mkdir()
    (tmp_path / "incoming" / "half" / "archive").write_bytes(
        b"PK"
    )  # the server died during this upload

    async with killed_server(tmp_path) as client:
        jobs = [await ended(client, job_id) for job_id in job_ids]
        after = [await disparities(client, job_id) for job_id in job_ids]
        assert not files_below(tmp_path / "incoming")
    assert [job["state"] for job in jobs] == ["done"] * len(ARCHIVES)

    async with http_server(RecallModel()) as client:
        for archive, maps in zip(ARCHIVES, after, strict=True):
            job = await submit(client, archive)
            await ended(client, job["id"])
            np.testing.assert_array_equal(maps, await disparities(client, job["id"]))


def checkpoints_below(directory: Path) -> list[Path]:
    return list(directory.glob("jobs/*/checkpoint"))


async def frames_stepped(client: httpx.AsyncClient) -> int:
    text = await metrics_of(client)
    counts = re.findall(r"^vergence_frames_stepped_total\{.*\} (.+)$", text, re.MULTILINE)
    return round(sum(map(float, counts)))


async def test_a_sequence_goes_on_from_where_it_was_when_the_server_was_killed(
    tmp_path: Path,
) -> None:
    archive = zip_bytes(sequence_files(make_frames(60)))
    # The job takes twelve seconds and is killed after one, which is in time on a busy machine too.
    async with killed_server(tmp_path, step_s=0.2) as client:
        job_id = (await submit(client, archive, metrics=True))["id"]
        await eventually(lambda: checkpoints_below(tmp_path))
    async with killed_server(tmp_path) as client:
        job = await ended(client, job_id)
        resumed = await disparities(client, job_id)
        stepped = await frames_stepped(client)
        await eventually(lambda: not checkpoints_below(tmp_path))  # removed when the job ends
    assert job["state"] == "done"
    assert 0 < stepped < 60, "the second server began at the first frame"

    async with http_server(RecallModel()) as client:
        whole = await ended(client, (await submit(client, archive, metrics=True))["id"])
        np.testing.assert_array_equal(resumed, await disparities(client, whole["id"]))
    assert job["accuracy"] == whole["accuracy"]


async def test_a_batch_goes_on_when_its_server_is_killed_and_comes_back(tmp_path: Path) -> None:
    rooms = [
        write_sequence(tmp_path / f"room-{n}", make_frames(4, brightness=10 * n))
        for n in range(1, 6)
    ]
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    going = asyncio.create_task(
        batch(
            rooms,
            server=f"http://127.0.0.1:{port}",
            out=tmp_path / "out",
            form="npz",
            query={},
            json=tmp_path / "batch.json",
            console=Console(file=io.StringIO()),
        )
    )
    async with killed_server(tmp_path / "jobs", step_s=0.04, port=port) as _:
        async with asyncio.timeout(PATIENCE_S):
            await eventually(lambda: any((tmp_path / "jobs" / "jobs").iterdir()))
    assert not going.done()
    async with killed_server(tmp_path / "jobs", port=port):
        await asyncio.wait_for(going, PATIENCE_S)
    figures = json.loads((tmp_path / "batch.json").read_text())
    assert (figures["failed"], figures["frames"]) == (0, 20)
    for room in rooms:
        assert len(list((tmp_path / "out" / room.name).glob("*.npz"))) == 4
