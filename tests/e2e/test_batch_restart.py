"""An accepted sequence is done, whatever happens to the process in between."""

import asyncio
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import httpx
import numpy as np

from tests.support.http import disparities, ended, files_below, http_server, submit
from tests.support.models import RecallModel
from tests.support.sequences import make_frames, sequence_files, zip_bytes
from tests.support.server import PATIENCE_S

REPOSITORY = Path(__file__).parents[2]
ARCHIVES = [zip_bytes(sequence_files(make_frames(5, brightness=10 * n))) for n in range(1, 21)]


@asynccontextmanager
async def killed_server(
    directory: Path, *, step_s: float = 0.0
) -> AsyncIterator[httpx.AsyncClient]:
    """A server in a process of its own, which ends by SIGKILL."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "tests.e2e.batch_server", str(directory), str(step_s)),
        cwd=REPOSITORY,
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
    )
    try:
        assert process.stdout is not None
        address = (await process.stdout.readline()).decode().strip()
        assert address, "the server did not start"
        async with httpx.AsyncClient(base_url=f"http://{address}", timeout=PATIENCE_S) as client:
            yield client
    finally:
        process.kill()
        await process.wait()


async def test_a_killed_server_finishes_all_that_it_accepted(tmp_path: Path) -> None:
    # Slow enough that the kill is in the middle of the batch, and of a sequence.
    async with killed_server(tmp_path, step_s=0.04) as client:
        job_ids = [(await submit(client, archive))["id"] for archive in ARCHIVES]
        await ended(client, job_ids[2])
        before = {each["id"]: each["state"] for each in (await client.get("/v1/sequences")).json()}
    assert "queued" in before.values(), "the kill came too late to show anything"
    (tmp_path / "incoming" / "half").mkdir()
    (tmp_path / "incoming" / "half" / "archive").write_bytes(b"PK")  # an upload it died in

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
