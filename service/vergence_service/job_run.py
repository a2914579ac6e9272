"""One run of one job: its input stepped from the first frame to the last, its result on disk."""

import asyncio
from collections import deque
from collections.abc import Callable
from contextlib import aclosing
from pathlib import Path

from vergence_proto.accuracy import Accuracy, accuracy
from vergence_proto.layouts import LayoutError, StereoSource
from vergence_proto.types import Delivery, OutputFormat
from vergence_service.engine import DepthEngine
from vergence_service.jobs import Job, JobOptions, Output
from vergence_service.results import start_result, write_frame
from vergence_service.sequences import (
    Stepped,
    open_below,
    sequence_error,
    step_all,
    without_truth,
)
from vergence_service.streams import Opening

# Frames that are being written while the next ones are stepped.
_UNWRITTEN = 2


def opening_of(source: StereoSource, options: JobOptions) -> Opening:
    """How a sequence is stepped; lossless, so it gives way to live streams.

    The iterations of a lone pair are those of its cold start, as in ``vergence run``.
    """
    alone = source.fps is None and len(source) == 1
    return Opening(
        source.rig,
        delivery=Delivery.EVERY,
        output=OutputFormat(confidence=Output.CONFIDENCE in options.outputs),
        iterations=options.iterations,
        cold_iterations=options.iterations if alone else 0,
    )


async def run_job(
    engine: DepthEngine, folder: Path, job: Job, on_frame: Callable[[], None]
) -> Accuracy | None:
    """Fill ``folder``/result from ``folder``/input, from the start, whatever is there already.

    Returns the mean accuracy if the job asks for it and there is truth. Raises as step_all, and
    BadSequence: a file of the input cannot be read.
    """
    source = await asyncio.to_thread(open_below, folder / "input", job.source)
    if not job.options.metrics:
        source = without_truth(source)
    found: list[Accuracy] = []
    writing: deque[asyncio.Task[Accuracy | None]] = deque()

    async def settle() -> None:
        measured = await writing.popleft()
        if measured is not None:
            found.append(measured)
        on_frame()

    try:
        async with aclosing(step_all(engine, source, opening_of(source, job.options))) as steps:
            async for stepped in steps:
                if stepped.index == 0:
                    rig = stepped.disparity.rig
                    await asyncio.to_thread(start_result, folder / "result", rig)
                if len(writing) == _UNWRITTEN:
                    await settle()
                keep = asyncio.to_thread(_keep, folder / "result", stepped)
                writing.append(asyncio.create_task(keep))
        while writing:
            await settle()
    except LayoutError as error:
        raise sequence_error(error, folder / "input") from None
    finally:
        # Nothing is written any more once this has returned, so the folder can be removed.
        await asyncio.gather(*writing, return_exceptions=True)
    mean = Accuracy.mean(found)
    return mean if mean.n else None


def _keep(folder: Path, stepped: Stepped) -> Accuracy | None:
    write_frame(folder, stepped.index, stepped.disparity)
    source = stepped.source
    if source.truth_px is None:
        return None
    return accuracy(stepped.disparity.offset_px, source.truth_px, source.truth_mask)
