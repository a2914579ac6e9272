"""Jobs that are stepped more than once: a pass backward, and a closer look at every frame."""

import asyncio
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.http import disparities, ended, http_server, submit
from tests.support.models import RecallModel
from tests.support.sequences import make_frames, sequence_files, zip_bytes
from vergence_service.inference.model import Step, StepResult

FRAMES = make_frames(6)
ARCHIVE = zip_bytes(sequence_files(FRAMES))
ALONE = zip_bytes(item for item in sequence_files(FRAMES) if item[0] != "poses.txt")
STORED_PX = 1 / 64


async def test_more_passes_are_the_mean_of_the_maps_that_agree() -> None:
    async with http_server(RecallModel()) as client:

        async def maps(archive: bytes, **query: str) -> np.ndarray[tuple[int, ...], np.dtype[Any]]:
            job = await submit(client, archive, **query)
            assert (await ended(client, job["id"]))["state"] == "done"
            return np.stack(await disparities(client, job["id"]))

        forward, alone = await maps(ARCHIVE), await maps(ALONE)
        backward = (await maps(zip_bytes(sequence_files(FRAMES[::-1]))))[::-1]
        steady, best = await maps(ARCHIVE, quality="steady"), await maps(ARCHIVE, quality="best")
        np.testing.assert_array_equal(await maps(ALONE, quality="best"), alone)
    both = np.abs(forward - backward) < 1.9
    assert both.any()
    np.testing.assert_allclose(steady[both], ((forward + backward) / 2)[both], atol=2 * STORED_PX)
    # The first frame has no state: its closer look is itself.
    all_three = np.stack([forward, alone, backward])[:, 1:]
    apart = np.abs(all_three - np.median(all_three, axis=0))
    near, clear = apart <= 2, (np.abs(apart - 2) > 0.1).all(axis=0)
    assert clear.any()
    expected = (all_three * near).sum(axis=0) / near.sum(axis=0)
    np.testing.assert_allclose(best[1:][clear], expected[clear], atol=2 * STORED_PX)


async def test_a_quality_that_changes_nothing_is_said_at_once() -> None:
    single = zip_bytes(sequence_files(FRAMES[:1]))
    async with http_server(RecallModel()) as client:
        for archive, why in ((ALONE, "no frame has a pose"), (single, "one frame")):
            job = await submit(client, archive, quality="best")
            said = {each["kind"]: each["message"] for each in job["warnings"]}
            assert why in said["quality"]
        useful = await submit(client, ARCHIVE, quality="best")
        assert useful["warnings"] == []


class StopsOnce(RecallModel):
    """It stays in one step until it is let go."""

    def __init__(self, at: int) -> None:
        super().__init__()
        self._at = at
        self.stopped = asyncio.Event()
        self._loop = asyncio.get_running_loop()

    def step(self, steps: Sequence[Step]) -> list[StepResult]:
        if len(self.batches) == self._at:
            self._free.clear()
            self._loop.call_soon_threadsafe(self.stopped.set)
        return super().step(steps)


@pytest.mark.parametrize(
    "at",
    [
        pytest.param(30, marks=pytest.mark.slow, id="back 1"),
        pytest.param(80, marks=pytest.mark.slow, id="forth 1"),
        pytest.param(100, marks=pytest.mark.slow, id="back 2"),
        pytest.param(103, id="forth 2"),
    ],
)
async def test_a_job_of_many_passes_continues_with_the_same_bits(at: int, tmp_path: Path) -> None:
    archive = zip_bytes(sequence_files(make_frames(51)))
    model = StopsOnce(at)
    async with http_server(model, batch__directory=tmp_path) as client:
        job = await submit(client, archive, quality="steady")
        await model.stopped.wait()
        # The model is freed when the server has begun to stop.
        asyncio.get_running_loop().call_later(0.1, model.let_go)
    async with http_server(RecallModel(), batch__directory=tmp_path) as client:
        again = await submit(client, archive, quality="steady")
        for each in (job, again):
            assert (await ended(client, each["id"]))["state"] == "done"
            assert not (tmp_path / "jobs" / each["id"] / "passes").exists()
        np.testing.assert_array_equal(
            await disparities(client, job["id"]), await disparities(client, again["id"])
        )
