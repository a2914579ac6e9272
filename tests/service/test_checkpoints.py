"""A sequence continues from its checkpoint, to the bit, or starts again if it is damaged."""

import asyncio
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.support.frames import RIG, make_frame
from tests.support.models import RecallModel
from tests.support.polling import eventually, turns
from tests.support.sequences import make_frames, write_sequence
from tests.support.server import running_server
from vergence_service.inference.model import Step, StepResult, StereoView
from vergence_service.inference.onnx_model import OnnxStereoModel, packaged_weights_dir
from vergence_service.inference.snapshots import BadSnapshot, state_from_bytes, state_to_bytes
from vergence_service.jobs.checkpoints import read_checkpoint, write_checkpoint
from vergence_service.jobs.job import Job, JobOptions
from vergence_service.jobs.progress import JobProgress
from vergence_service.jobs.results import read_frames
from vergence_service.jobs.run import Finished, run_job

FRAMES = 24


def make_view(frame_id: int, *, posed: bool = True) -> StereoView:
    frame = make_frame(frame_id, brightness=40 + frame_id)
    assert frame.pose is not None
    pose = frame.pose.world_from_left if posed else None
    return StereoView(frame.left, frame.right, RIG, frame.capture_ns, pose)


@pytest.fixture(scope="module")
def model() -> OnnxStereoModel:
    return OnnxStereoModel(
        packaged_weights_dir(), "lite", providers=["cpu"], threads=1, allow_spinning=False
    )


def test_a_step_on_a_state_that_was_bytes_is_the_same_to_the_bit(model: OnnxStereoModel) -> None:
    [first] = model.step([Step(make_view(1), None, 1)])
    [expected] = model.step([Step(make_view(2), first.state, 1)])
    restored = state_from_bytes(state_to_bytes(first.state))
    [result] = model.step([Step(make_view(2), restored, 1)])
    np.testing.assert_array_equal(result.offset_px, expected.offset_px)
    for tensor, same in zip(result.state.tensors, expected.state.tensors, strict=True):
        np.testing.assert_array_equal(tensor, same)
    assert (restored.rig, restored.capture_ns) == (RIG, first.state.capture_ns)
    assert (restored.step_count, restored.position_known) == (1, True)


def test_a_state_without_a_pose_comes_back_without_one() -> None:
    [result] = RecallModel().step([Step(make_view(1, posed=False), None, 1)])
    assert state_from_bytes(state_to_bytes(result.state)).world_from_left is None


def test_bytes_that_are_no_state_are_refused() -> None:
    [result] = RecallModel().step([Step(make_view(1), None, 1)])
    whole = state_to_bytes(result.state)
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1
    for data in (b"", b"PK", whole[:-1], whole[: len(whole) // 2], bytes(flipped)):
        with pytest.raises(BadSnapshot):
            state_from_bytes(data)


class StopsAfter(RecallModel):
    """A model that takes so many steps, and stays in the next until ``let_go``."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self._count = count

    def step(self, steps: Sequence[Step]) -> list[StepResult]:
        if len(self.batches) == self._count:
            self._free.clear()
        return super().step(steps)


def make_job(folder: Path, *, metrics: bool = False, frames: int = FRAMES) -> Job:
    write_sequence(folder / "input", make_frames(frames))
    options = JobOptions(metrics=metrics)
    return Job(
        job_id="j",
        source="vergence:",
        frames=frames,
        source_fps=30.0,
        created_s=0.0,
        options=options,
    )


async def run(model: RecallModel, folder: Path, job: Job) -> tuple[JobProgress, Finished]:
    progress = JobProgress()
    async with running_server(model) as server:
        found = await run_job(server.engine, folder, job, progress, checkpoint_s=1e-9)
    return progress, found


async def run_to_the_middle(folder: Path, job: Job) -> None:
    model, progress = StopsAfter(FRAMES // 2), JobProgress()
    async with running_server(model) as server:
        work = asyncio.create_task(run_job(server.engine, folder, job, progress, checkpoint_s=1e-9))
        # Not before the model has stopped: nobody would let it go.
        await eventually(lambda: len(model.batches) > FRAMES // 2)
        # Of those that were stepped, two are in the queue of answers and two in that of writes.
        await eventually(lambda: progress.frames_done >= FRAMES // 2 - 4)
        work.cancel()
        await asyncio.gather(work, return_exceptions=True)
        model.let_go()


def maps_in(folder: Path) -> list[NDArray[np.float32]]:
    frames = read_frames(folder / "result")
    return [frame.disparity.offset_px for frame in frames if frame.disparity is not None]


async def test_a_sequence_continues_from_its_checkpoint_to_the_bit(tmp_path: Path) -> None:
    job = make_job(tmp_path / "halved", metrics=True)
    await run_to_the_middle(tmp_path / "halved", job)
    checkpoint = read_checkpoint(tmp_path / "halved" / "checkpoint")
    assert checkpoint is not None
    assert 0 < checkpoint.frames < FRAMES
    model = RecallModel()
    progress, found = await run(model, tmp_path / "halved", job)
    assert len(model.batches) == FRAMES - checkpoint.frames
    assert (progress.frames_found, progress.frames_done) == (checkpoint.frames, FRAMES)

    whole = make_job(tmp_path / "whole", metrics=True)
    _, expected = await run(RecallModel(), tmp_path / "whole", whole)
    np.testing.assert_array_equal(maps_in(tmp_path / "halved"), maps_in(tmp_path / "whole"))
    assert expected is not None
    assert found == expected


def truncated(folder: Path) -> None:
    path = folder / "checkpoint"
    path.write_bytes(path.read_bytes()[:-100])


def of_other_weights(folder: Path) -> None:
    path = folder / "checkpoint"
    checkpoint = read_checkpoint(path)
    assert checkpoint is not None
    write_checkpoint(path, replace(checkpoint, weights_sha256="1" * 64))


def with_a_result_lost(folder: Path) -> None:
    (folder / "result" / "000001.frame").write_bytes(b"")


@pytest.mark.parametrize("spoil", [truncated, of_other_weights, with_a_result_lost])
async def test_a_sequence_without_a_usable_checkpoint_is_done_again(
    tmp_path: Path, spoil: Callable[[Path], None]
) -> None:
    job = make_job(tmp_path)
    await run_to_the_middle(tmp_path, job)
    spoil(tmp_path)
    model = RecallModel()
    progress, _ = await run(model, tmp_path, job)
    assert progress.frames_found == 0
    assert len(model.batches) == len(maps_in(tmp_path)) == FRAMES


async def test_no_file_is_written_after_a_run_was_cancelled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    let_go = threading.Event()
    writing: list[int] = []
    written: list[int] = []

    def write_slowly(folder: Path, index: int, disparity: object) -> None:
        writing.append(index)
        assert let_go.wait(timeout=30)
        written.append(index)

    monkeypatch.setattr("vergence_service.jobs.run.write_frame", write_slowly)
    job = make_job(tmp_path, frames=1)
    async with running_server(RecallModel()) as server:
        run = asyncio.create_task(
            run_job(server.engine, tmp_path, job, JobProgress(), checkpoint_s=1e-9)
        )
        await eventually(lambda: len(writing) == 1)
        await turns()
        run.cancel()
        await turns()
        assert not run.done(), "the run ended while a thread was writing"
        let_go.set()
        await asyncio.gather(run, return_exceptions=True)
    assert written == [0]
