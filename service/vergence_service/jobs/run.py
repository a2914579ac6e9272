"""Run one job: step its input to the last frame and write the result to disk."""

import time
from collections.abc import AsyncGenerator, AsyncIterable
from contextlib import aclosing, suppress
from dataclasses import dataclass
from pathlib import Path

from vergence_proto.accuracy import Accuracy, accuracy
from vergence_proto.datasets import DatasetError, StereoSource
from vergence_proto.errors import BadSequence
from vergence_proto.jobs import Output
from vergence_proto.ordered import in_order
from vergence_proto.types import Delivery, OutputFormat
from vergence_service.jobs.checkpoints import Checkpoint, read_checkpoint, write_checkpoint
from vergence_service.jobs.job import Job, JobOptions
from vergence_service.jobs.progress import JobProgress
from vergence_service.jobs.results import (
    checking_frames,
    count_frames,
    start_result,
    write_frame,
)
from vergence_service.jobs.sources import open_below, relative_text, sequence_error
from vergence_service.jobs.stepping import Stepped, step_all
from vergence_service.jobs.storage import disk_trouble
from vergence_service.streams.engine import DepthEngine
from vergence_service.streams.stream import StreamConfig
from vergence_service.threads import ThreadPool

# Frames that are being written while the next ones are stepped.
_UNWRITTEN = 2
CHECKPOINT = "checkpoint"
_NAMED_AT_MOST = 20


def job_stream_config(sequence: StereoSource, options: JobOptions) -> StreamConfig:
    """Return the configuration of a job's stream. It is lossless, so live streams come first.

    For a single pair, the iterations are those of its cold start, as in ``vergence run``.
    """
    return StreamConfig(
        sequence.rig,
        delivery=Delivery.EVERY,
        output=OutputFormat(
            confidence=Output.CONFIDENCE in options.outputs, sigma=Output.SIGMA in options.outputs
        ),
        iterations=options.iterations,
        cold_iterations=options.iterations if sequence.is_single_pair else 0,
    )


@dataclass(frozen=True, slots=True)
class Finished:
    """What a run found out about its sequence."""

    accuracy: Accuracy | None  # the mean, if the job asks for it and the upload has ground truth
    frames_unread: int  # frames without a result, because an image could not be read
    notes: tuple[str, ...]  # what is missing or does not fit; of many files only some are named


async def run_job(
    engine: DepthEngine, folder: Path, job: Job, progress: JobProgress, *, checkpoint_s: float
) -> Finished:
    """Make ``folder``/result from ``folder``/input, continuing from the last checkpoint.

    A crash costs at most the work of ``checkpoint_s``.

    Raises BadSequence if no frame of the input can be read; NotReady or Draining if the server
    accepts no work; and BadCalibration, FrameTooLarge, BadShape, ModelFailed or NonFinite if a
    frame cannot be stepped.
    """
    background = engine.threads.background
    sequence = await background.run(open_below, folder / "input", job.source)
    if not job.options.metrics:
        sequence = sequence.without_truth()
    result = folder / "result"
    before = await _usable_checkpoint(folder, engine.card.weights_sha256, background)
    if before is None:
        # First of all: a checkpoint of other weights must not continue the frames of this run.
        await background.run((folder / CHECKPOINT).unlink, missing_ok=True)
    start, state = (before.frames, before.state) if before else (0, None)
    measured = list(before.measured) if before else []
    unread = dict(before.unread) if before else {}

    def skip(index: int, error: DatasetError) -> None:
        if disk_trouble(error) is not None:
            raise error  # the file is there; later it can be read
        unread[index] = str(sequence_error(error, folder / "input"))

    progress.frames_found = progress.frames_done = start
    unsaved: Stepped | None = None  # the last frame that was written since the last checkpoint
    checkpoint_due_s = time.monotonic() + checkpoint_s

    async def write(stepped: Stepped) -> tuple[Stepped, Accuracy | None]:
        return stepped, await background.run(_write_and_measure, result, stepped)

    async def save(stepped: Stepped) -> None:
        checkpoint = Checkpoint(
            stepped.index + 1,
            stepped.state,
            engine.card.weights_sha256,
            tuple(measured),
            {index: why for index, why in unread.items() if index <= stepped.index},
        )
        await background.run(write_checkpoint, folder / CHECKPOINT, checkpoint)

    config = job_stream_config(sequence, job.options)
    try:
        async with (
            aclosing(
                step_all(engine, sequence, config, start=start, state=state, on_unreadable=skip)
            ) as steps,
            aclosing(_started(result, steps, background, anew=start == 0)) as started,
            # No thread writes any more when this is closed. Then the folder can be removed.
            aclosing(in_order(started, write, limit=_UNWRITTEN, cancel_rest=False)) as written,
        ):
            async for stepped, found in written:
                if found is not None:
                    measured.append(found)
                progress.advance(stepped.index + 1)
                engine.metrics.sequence_frames.inc()
                unsaved = stepped
                if time.monotonic() >= checkpoint_due_s:
                    await save(stepped)
                    unsaved = None
                    checkpoint_due_s = time.monotonic() + checkpoint_s
    except BaseException:
        if unsaved is not None:
            with suppress(OSError):  # the next server continues from here, or from the last one
                await save(unsaved)
        raise
    if not progress.frames_done:
        raise BadSequence(next(iter(unread.values()), f"{job.source}: no frames"))
    mean = Accuracy.mean(measured)
    notes = [relative_text(note, folder / "input") for note in sequence.notes]
    return Finished(
        mean if mean.n else None,
        len(sequence) - await background.run(count_frames, result),
        (*notes, *list(unread.values())[:_NAMED_AT_MOST]),
    )


async def _started(
    result: Path, steps: AsyncIterable[Stepped], background: ThreadPool, *, anew: bool
) -> AsyncGenerator[Stepped, None]:
    """Pass the steps on. ``anew``: empty the result's folder before the first one."""
    async for stepped in steps:
        if anew:
            await background.run(start_result, result, stepped.disparity.rig)
            anew = False
        yield stepped


async def _usable_checkpoint(
    folder: Path, weights_sha256: str, background: ThreadPool
) -> Checkpoint | None:
    """Return the checkpoint to continue from: a result must come from one set of weights."""
    checkpoint = await background.run(read_checkpoint, folder / CHECKPOINT)
    if checkpoint is None or checkpoint.weights_sha256 != weights_sha256:
        return None
    checking = checking_frames(folder / "result", checkpoint.frames, without=checkpoint.unread)
    complete = [each async for each in background.iterate(checking)]
    return checkpoint if all(complete) else None


def _write_and_measure(folder: Path, stepped: Stepped) -> Accuracy | None:
    write_frame(folder, stepped.index, stepped.disparity)
    source = stepped.source
    if source.truth_px is None:
        return None
    return accuracy(stepped.disparity.offset_px, source.truth_px, source.truth_mask)
