"""One run of one job: its input stepped to the last frame, its result on disk."""

import asyncio
import time
from collections import deque
from contextlib import aclosing
from dataclasses import dataclass, field
from pathlib import Path

from vergence_proto.accuracy import Accuracy, accuracy
from vergence_proto.datasets import LayoutError, StereoSource
from vergence_proto.jobs import Output
from vergence_proto.types import Delivery, OutputFormat
from vergence_service.jobs.checkpoints import Checkpoint, read_checkpoint, write_checkpoint
from vergence_service.jobs.job import Job, JobOptions
from vergence_service.jobs.results import holds_frames, start_result, write_frame
from vergence_service.jobs.sources import open_below, sequence_error, without_truth
from vergence_service.jobs.stepping import Stepped, step_all
from vergence_service.streams.engine import DepthEngine
from vergence_service.streams.stream import StreamConfig

# Frames that are being written while the next ones are stepped.
_UNWRITTEN = 2
_CHECKPOINT = "checkpoint"


@dataclass(slots=True, eq=False)
class JobProgress:
    """How far a run is."""

    since_s: float = field(default_factory=time.monotonic)
    frames_found: int = 0  # that an earlier run had done
    frames_done: int = 0  # those included

    @property
    def fps(self) -> float:
        elapsed_s = time.monotonic() - self.since_s
        return (self.frames_done - self.frames_found) / max(elapsed_s, 1e-6)

    def eta_s(self, frames: int) -> float | None:
        """Until all ``frames`` are done; None before the first one was."""
        return (frames - self.frames_done) / self.fps if self.fps else None


def job_stream_config(source: StereoSource, options: JobOptions) -> StreamConfig:
    """How a sequence is stepped; lossless, so it gives way to live streams.

    The iterations of a lone pair are those of its cold start, as in ``vergence run``.
    """
    return StreamConfig(
        source.rig,
        delivery=Delivery.EVERY,
        output=OutputFormat(confidence=Output.CONFIDENCE in options.outputs),
        iterations=options.iterations,
        cold_iterations=options.iterations if source.is_single_pair else 0,
    )


async def run_job(
    engine: DepthEngine, folder: Path, job: Job, progress: JobProgress, *, checkpoint_s: float
) -> Accuracy | None:
    """Fill ``folder``/result from ``folder``/input, from where an earlier run has left it.

    What a crash costs is at most the work of the last ``checkpoint_s``. Returns the mean accuracy
    if the job asks for it and there is truth. Raises as step_all, and BadSequence: a file of the
    input cannot be read.
    """
    source = await asyncio.to_thread(open_below, folder / "input", job.source)
    if not job.options.metrics:
        source = without_truth(source)
    before = await asyncio.to_thread(_found, folder, engine.card.weights_sha256)
    start, state = (before.frames, before.state) if before else (0, None)
    measured = list(before.measured) if before else []
    progress.frames_found = progress.frames_done = start
    checkpoint_due_s = time.monotonic() + checkpoint_s
    writing: deque[tuple[Stepped, asyncio.Task[Accuracy | None]]] = deque()

    async def settle() -> None:
        nonlocal checkpoint_due_s
        stepped, written = writing.popleft()
        found = await written
        if found is not None:
            measured.append(found)
        progress.frames_done += 1
        engine.metrics.sequence_frames.inc()
        if time.monotonic() >= checkpoint_due_s:
            checkpoint = Checkpoint(
                progress.frames_done, stepped.state, engine.card.weights_sha256, tuple(measured)
            )
            await asyncio.to_thread(write_checkpoint, folder / _CHECKPOINT, checkpoint)
            checkpoint_due_s = time.monotonic() + checkpoint_s

    steps = step_all(
        engine, source, job_stream_config(source, job.options), start=start, state=state
    )
    try:
        async with aclosing(steps):
            async for stepped in steps:
                if stepped.index == 0:
                    rig = stepped.disparity.rig
                    await asyncio.to_thread(start_result, folder / "result", rig)
                if len(writing) == _UNWRITTEN:
                    await settle()
                keep = asyncio.to_thread(_keep, folder / "result", stepped)
                writing.append((stepped, asyncio.create_task(keep)))
        while writing:
            await settle()
    except LayoutError as error:
        raise sequence_error(error, folder / "input") from None
    finally:
        # Nothing is written any more once this has returned, so the folder can be removed.
        await asyncio.gather(*(task for _, task in writing), return_exceptions=True)
    mean = Accuracy.mean(measured)
    return mean if mean.n else None


def _found(folder: Path, weights_sha256: str) -> Checkpoint | None:
    """What can be gone on from: all of a result comes from the same weights."""
    checkpoint = read_checkpoint(folder / _CHECKPOINT)
    if checkpoint is None or checkpoint.weights_sha256 != weights_sha256:
        return None
    return checkpoint if holds_frames(folder / "result", checkpoint.frames) else None


def _keep(folder: Path, stepped: Stepped) -> Accuracy | None:
    write_frame(folder, stepped.index, stepped.disparity)
    source = stepped.source
    if source.truth_px is None:
        return None
    return accuracy(stepped.disparity.offset_px, source.truth_px, source.truth_mask)
