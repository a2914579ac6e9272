"""Run one job: step its input to the last frame and write the result to disk."""

import asyncio
import time
from collections.abc import AsyncGenerator, AsyncIterable
from contextlib import aclosing, suppress
from pathlib import Path

from vergence_proto.accuracy import Accuracy, accuracy
from vergence_proto.datasets import DatasetError, StereoSource
from vergence_proto.errors import Draining
from vergence_proto.jobs import Output
from vergence_proto.ordered import in_order
from vergence_proto.types import Delivery, OutputFormat
from vergence_service.jobs.checkpoints import Checkpoint, read_checkpoint, write_checkpoint
from vergence_service.jobs.job import Job, JobOptions
from vergence_service.jobs.progress import JobProgress
from vergence_service.jobs.results import holds_frames, start_result, write_frame
from vergence_service.jobs.sources import open_below, sequence_error
from vergence_service.jobs.stepping import Stepped, step_all
from vergence_service.streams.engine import DepthEngine
from vergence_service.streams.stream import StreamConfig
from vergence_service.threads import ThreadPool

# Frames that are being written while the next ones are stepped.
_UNWRITTEN = 2
_CHECKPOINT = "checkpoint"


def job_stream_config(sequence: StereoSource, options: JobOptions) -> StreamConfig:
    """Return the configuration of a job's stream. It is lossless, so live streams come first.

    For a single pair, the iterations are those of its cold start, as in ``vergence run``.
    """
    return StreamConfig(
        sequence.rig,
        delivery=Delivery.EVERY,
        output=OutputFormat(confidence=Output.CONFIDENCE in options.outputs),
        iterations=options.iterations,
        cold_iterations=options.iterations if sequence.is_single_pair else 0,
    )


async def run_job(
    engine: DepthEngine, folder: Path, job: Job, progress: JobProgress, *, checkpoint_s: float
) -> Accuracy | None:
    """Make ``folder``/result from ``folder``/input, continuing from the last checkpoint.

    A crash costs at most the work of ``checkpoint_s``. Returns the mean accuracy if the job asks
    for it and the upload has ground truth.

    Raises BadSequence if a file of the input cannot be read; NotReady or Draining if the server
    accepts no work; and BadCalibration, FrameTooLarge, BadShape, ModelFailed or NonFinite if a
    frame cannot be stepped.
    """
    background = engine.threads.background
    sequence = await background.run(open_below, folder / "input", job.source)
    if not job.options.metrics:
        sequence = sequence.without_truth()
    result = folder / "result"
    before = await background.run(_usable_checkpoint, folder, engine.card.weights_sha256)
    start, state = (before.frames, before.state) if before else (0, None)
    measured = list(before.measured) if before else []
    progress.frames_found = progress.frames_done = start
    unsaved: Stepped | None = None  # the last frame that was written since the last checkpoint
    checkpoint_due_s = time.monotonic() + checkpoint_s

    async def write(stepped: Stepped) -> tuple[Stepped, Accuracy | None]:
        return stepped, await background.run(_write_and_measure, result, stepped)

    async def save(stepped: Stepped) -> None:
        checkpoint = Checkpoint(
            stepped.index + 1, stepped.state, engine.card.weights_sha256, tuple(measured)
        )
        await background.run(write_checkpoint, folder / _CHECKPOINT, checkpoint)

    config = job_stream_config(sequence, job.options)
    try:
        async with (
            aclosing(step_all(engine, sequence, config, start=start, state=state)) as steps,
            aclosing(_started(result, steps, background)) as started,
            # No thread writes any more when this is closed. Then the folder can be removed.
            aclosing(in_order(started, write, limit=_UNWRITTEN, cancel_rest=False)) as written,
        ):
            async for stepped, found in written:
                if found is not None:
                    measured.append(found)
                progress.frames_done += 1
                engine.metrics.sequence_frames.inc()
                unsaved = stepped
                if time.monotonic() >= checkpoint_due_s:
                    await save(stepped)
                    unsaved = None
                    checkpoint_due_s = time.monotonic() + checkpoint_s
    except DatasetError as error:
        raise sequence_error(error, folder / "input") from None
    except (asyncio.CancelledError, Draining):
        if unsaved is not None:
            with suppress(OSError):  # the next server continues from here, or from the last one
                await save(unsaved)
        raise
    mean = Accuracy.mean(measured)
    return mean if mean.n else None


async def _started(
    result: Path, steps: AsyncIterable[Stepped], background: ThreadPool
) -> AsyncGenerator[Stepped, None]:
    """Pass the steps on. Empty the result's folder before the first frame of the sequence."""
    async for stepped in steps:
        if stepped.index == 0:
            await background.run(start_result, result, stepped.disparity.rig)
        yield stepped


def _usable_checkpoint(folder: Path, weights_sha256: str) -> Checkpoint | None:
    """Return the checkpoint to continue from: a result must come from one set of weights."""
    checkpoint = read_checkpoint(folder / _CHECKPOINT)
    if checkpoint is None or checkpoint.weights_sha256 != weights_sha256:
        return None
    return checkpoint if holds_frames(folder / "result", checkpoint.frames) else None


def _write_and_measure(folder: Path, stepped: Stepped) -> Accuracy | None:
    write_frame(folder, stepped.index, stepped.disparity)
    source = stepped.source
    if source.truth_px is None:
        return None
    return accuracy(stepped.disparity.offset_px, source.truth_px, source.truth_mask)
