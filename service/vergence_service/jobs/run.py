"""Run one job: step its input to the last frame and write the result to disk."""

import dataclasses
import math
import time
from collections.abc import AsyncGenerator, AsyncIterable
from contextlib import aclosing, suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np

from vergence_proto.accuracy import Accuracy, accuracy
from vergence_proto.datasets import DatasetError, StereoSource
from vergence_proto.errors import BadSequence, DepthError
from vergence_proto.job_results.frame_file import encode_frame
from vergence_proto.job_results.records import FrameRecord
from vergence_proto.jobs import JobOutput, OnError
from vergence_proto.ordered import in_order
from vergence_proto.types import Delivery, DisparityMap, OutputFormat
from vergence_service.jobs.checkpoints import Checkpoint, read_checkpoint, write_checkpoint
from vergence_service.jobs.job import Job, JobOptions
from vergence_service.jobs.left_image import left_image
from vergence_service.jobs.passes import step_passes
from vergence_service.jobs.progress import JobProgress
from vergence_service.jobs.results import (
    Made,
    checking_frames,
    read_made,
    start_result,
    write_frame,
    write_made,
)
from vergence_service.jobs.sources import open_below, relative_text, sequence_error
from vergence_service.jobs.stepping import Skipped, Stepped
from vergence_service.jobs.storage import disk_trouble
from vergence_service.jobs.tally import FrameCounts
from vergence_service.process.threads import ThreadPool
from vergence_service.streams.engine import DepthEngine
from vergence_service.streams.rectify import Rectifier
from vergence_service.streams.stream import StreamConfig

# Frames that are being written while the next ones are stepped.
_UNWRITTEN = 2
CHECKPOINT = "checkpoint"
PASSES = "passes"


def job_stream_config(sequence: StereoSource, options: JobOptions) -> StreamConfig:
    """Return the configuration of a job's stream. It is lossless, so live streams come first.

    For a single pair, the iterations are those of its cold start, as in ``vergence run``.
    """
    return StreamConfig(
        sequence.rig,
        delivery=Delivery.EVERY,
        # The records state the mean sigma, also if nobody keeps the plane.
        output=OutputFormat(confidence=JobOutput.CONFIDENCE in options.outputs, sigma=True),
        iterations=options.iterations,
        cold_iterations=options.iterations if sequence.is_single_pair else 0,
    )


@dataclass(frozen=True, slots=True)
class Finished:
    """What a run found out about its sequence."""

    accuracy: Accuracy | None  # the mean, if the job asks for it and the upload has ground truth
    frames_failed: int  # frames without a map
    cold_frames: int  # frames that started without a state
    notes: tuple[str, ...]  # what is missing or does not fit; of many files only some are named


async def run_job(
    engine: DepthEngine, folder: Path, job: Job, progress: JobProgress, *, checkpoint_s: float
) -> Finished:
    """Make ``folder``/result from ``folder``/input, continuing from the last checkpoint.

    A crash costs at most the work of ``checkpoint_s``.

    Raises BadSequence if no frame of the input has a map; NotReady or Draining if the server
    accepts no work; BadCalibration, FrameTooLarge or ModelFailed if a frame cannot be stepped; and,
    if bad frames fail the job, BadSequence, BadShape or NonFinite.
    """
    background = engine.threads.background
    sequence = await background.run(open_below, folder / "input", job.source)
    if not job.options.metrics:
        sequence = sequence.without_truth()
    writer = _Writer(folder, job, sequence)
    before = await _usable_checkpoint(folder, engine.card.weights_sha256, background)
    if before is None:
        # First of all: a checkpoint of other weights must not continue the frames of this run.
        await background.run((folder / CHECKPOINT).unlink, missing_ok=True)
    start, state = (before.frames, before.state) if before else (0, None)
    tally = before.tally if before else FrameCounts()

    def may_skip(error: DatasetError | DepthError) -> bool:
        # What the disk refuses to read can be read later.
        return job.options.on_error is OnError.SKIP and disk_trouble(error) is None

    progress.frames_found = progress.frames_done = start
    unsaved: Stepped | None = None  # the last frame that was written since the last checkpoint
    checkpoint_due_s = time.monotonic() + checkpoint_s

    async def write(step: Stepped | Skipped) -> tuple[Stepped | Skipped, FrameRecord]:
        return step, await background.run(writer.write, step)

    async def save(stepped: Stepped) -> None:
        checkpoint = Checkpoint(
            stepped.index + 1, stepped.state, engine.card.weights_sha256, saved_tally
        )
        await background.run(write_checkpoint, folder / CHECKPOINT, checkpoint)

    config = job_stream_config(sequence, job.options)
    saved_tally = tally  # at the last frame with a map
    try:
        async with (
            aclosing(
                step_passes(
                    engine,
                    sequence,
                    config,
                    job.options.quality,
                    folder / PASSES,
                    start=start,
                    state=state,
                    may_skip=may_skip,
                    owner=job.owner,
                )
            ) as steps,
            aclosing(_started(writer.result, engine, steps, background, start)) as started,
            # No thread writes any more when this is closed. Then the folder can be removed.
            aclosing(in_order(started, write, limit=_UNWRITTEN, cancel_rest=False)) as written,
        ):
            async for step, record in written:
                tally = tally.after(record)
                progress.advance(step.index + 1)
                if isinstance(step, Skipped):
                    engine.metrics.sequence_frames_failed.inc()
                    continue
                engine.metrics.sequence_frames.inc()
                unsaved, saved_tally = step, tally
                if time.monotonic() >= checkpoint_due_s:
                    await save(step)
                    unsaved = None
                    checkpoint_due_s = time.monotonic() + checkpoint_s
    except DatasetError as error:
        raise sequence_error(error, folder / "input") from error
    finally:
        if unsaved is not None and progress.frames_done < len(sequence):
            with suppress(OSError):  # the next server continues from here, or from the last one
                await save(unsaved)
    if tally.frames == tally.failed:
        raise BadSequence(next(iter(tally.errors), f"{job.source}: no frames"))
    mean = Accuracy.mean(tally.measured)
    notes = [relative_text(note, folder / "input") for note in sequence.notes]
    return Finished(mean if mean.n else None, tally.failed, tally.cold, (*notes, *tally.errors))


async def _started(
    result: Path,
    engine: DepthEngine,
    steps: AsyncIterable[Stepped | Skipped],
    background: ThreadPool,
    start: int,
) -> AsyncGenerator[Stepped | Skipped, None]:
    """Pass the steps on; begin the result, or continue it, before the first one."""
    known = start > 0 and (await background.run(read_made, result)).rig is not None
    begun = start > 0
    async for step in steps:
        if not begun:
            await background.run(start_result, result, _made(engine, None))
            begun = True
        if not known and isinstance(step, Stepped):
            await background.run(write_made, result, _made(engine, step.rectifier))
            known = True
        yield step


def _made(engine: DepthEngine, rectifier: Rectifier | None) -> Made:
    return Made(
        vergence=version("vergence"),
        model=engine.card.name,
        weights_sha256=engine.card.weights_sha256,
        engine=engine.computed_by,
        provider=engine.provider,
        rig=None if rectifier is None else rectifier.rig,
        left_from_rectified=None if rectifier is None else rectifier.left_from_rectified,
    )


async def _usable_checkpoint(
    folder: Path, weights_sha256: str, background: ThreadPool
) -> Checkpoint | None:
    """Return the checkpoint to continue from: a result must come from one set of weights."""
    checkpoint = await background.run(read_checkpoint, folder / CHECKPOINT)
    if checkpoint is None or checkpoint.weights_sha256 != weights_sha256:
        return None
    checking = checking_frames(folder / "result", checkpoint.frames)
    complete = [each async for each in background.iterate(checking)]
    return checkpoint if all(complete) else None


class _Writer:
    """Writes the file of each frame of a job. Its methods block."""

    def __init__(self, folder: Path, job: Job, sequence: StereoSource) -> None:
        self.result = folder / "result"
        self._input = folder / "input"
        self._outputs = job.options.outputs
        self._sequence = sequence

    def write(self, step: Stepped | Skipped) -> FrameRecord:
        """Write one frame; return its record."""
        files = self._sequence.files[step.index]
        record = FrameRecord(
            index=step.index,
            left=relative_text(str(files.left), self._input),
            right=relative_text(str(files.right), self._input),
            capture_ns=files.capture_ns,
        )
        if isinstance(step, Skipped):
            record = dataclasses.replace(record, error=self._words(step.error))
            write_frame(self.result, step.index, encode_frame(record, None))
            return record
        disparity = step.make_map()
        record = self._described(record, step, disparity)
        left = None
        if JobOutput.LEFT in self._outputs:
            left = left_image(step.rectifier, files.left, step.source.frame.left)
        content = encode_frame(
            record,
            disparity,
            confidence=JobOutput.CONFIDENCE in self._outputs,
            sigma=JobOutput.SIGMA in self._outputs,
            left=left,
        )
        write_frame(self.result, step.index, content)
        return record

    def _described(
        self, record: FrameRecord, step: Stepped, disparity: DisparityMap
    ) -> FrameRecord:
        source = step.source
        measured = None
        if source.truth_px is not None:
            found = accuracy(disparity.offset_px, source.truth_px, source.truth_mask)
            measured = {
                name: value if math.isfinite(value) else None
                for name, value in dataclasses.asdict(found).items()
            }
        valid = disparity.valid
        share = float(valid.mean())
        assert disparity.sigma_px is not None  # every job asks for it
        with np.errstate(over="ignore"):
            sigma_px = float(disparity.sigma_px[valid].mean()) if share else math.nan
        return dataclasses.replace(
            record,
            note=None if step.note is None else self._words(step.note),
            world_from_left=disparity.world_from_left,
            origin=disparity.origin.value,
            iterations=disparity.iterations,
            step_count=disparity.step_count,
            valid_share=round(share, 5),
            mean_sigma_px=round(sigma_px, 5) if math.isfinite(sigma_px) else None,
            accuracy=measured,
        )

    def _words(self, error: DatasetError | DepthError) -> str:
        if isinstance(error, DatasetError):
            return str(sequence_error(error, self._input))
        return str(error)
