"""Better maps for more time: a pass backward in time, and a closer look at every frame.

The pass forward sees a surface first when it comes into view; the pass backward has seen it for
many frames by then. Their errors differ, so the fused map has fewer. A sequence is stepped backward
in blocks that begin at fixed frames: a job that continues after a crash makes the same bits, and
its first maps need not wait for the last frame.
"""

import dataclasses
from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing
from functools import partial
from pathlib import Path

from vergence_proto.datasets import DatasetError, StereoSource
from vergence_proto.errors import DepthError, NonFinite
from vergence_proto.job_results.frame_file import SUFFIX, decode_frame, encode_frame
from vergence_proto.job_results.records import FrameRecord
from vergence_proto.jobs import Quality
from vergence_proto.model_io import ModelCard
from vergence_proto.types import DisparityMap
from vergence_service.inference.model import RecurrentState
from vergence_service.jobs.fusion import fused
from vergence_service.jobs.stepping import Skipped, Stepped, step_all
from vergence_service.jobs.storage import disk_trouble
from vergence_service.jobs.store import remove_folder
from vergence_service.streams.engine import DepthEngine
from vergence_service.streams.stream import StreamConfig

BLOCK = 48  # frames whose maps of the pass backward are on the disk at once
_LEAD = 8  # frames behind a block that the pass backward begins with, until its state is good

MaySkip = Callable[[DatasetError | DepthError], bool]


async def step_passes(
    engine: DepthEngine,
    sequence: StereoSource,
    config: StreamConfig,
    quality: Quality,
    scratch: Path,
    *,
    start: int,
    state: RecurrentState | None,
    may_skip: MaySkip,
    owner: str,
) -> AsyncGenerator[Stepped | Skipped, None]:
    """Step the frames of ``sequence`` as :func:`step_all` does, as often as ``quality`` says.

    ``scratch`` is a folder for maps in between, which is made and removed.

    Raises what :func:`step_all` raises.
    """
    if quality is Quality.FAST or why_no_passes(sequence, engine.card) is not None:
        async with aclosing(
            step_all(
                engine,
                sequence,
                config,
                start=start,
                state=state,
                may_skip=may_skip,
                owner=owner,
            )
        ) as steps:
            async for step in steps:
                yield step
        return
    background = engine.threads.background
    try:
        for begin in range(start - start % BLOCK, len(sequence), BLOCK):
            first, end = max(begin, start), min(begin + BLOCK, len(sequence))
            await background.run(remove_folder, scratch)
            await background.run(scratch.mkdir)
            await _step_backward(
                engine, sequence, config, scratch, first=first, end=end, owner=owner
            )
            # A stream at a time: two would wait for the memory of each other.
            block = dataclasses.replace(sequence, files=sequence.files[:end])
            async with aclosing(
                step_all(
                    engine,
                    block,
                    config,
                    start=first,
                    state=state,
                    may_skip=may_skip,
                    alone=quality is Quality.BEST,
                    owner=owner,
                )
            ) as steps:
                async for step in steps:
                    if isinstance(step, Stepped):
                        state = step.state
                        backward = await background.run(_read, _path(scratch, step.index))
                        made = partial(_fused, step, backward)
                        yield dataclasses.replace(step, make_map=made, make_alone=None)
                        continue
                    if isinstance(step.error, NonFinite):
                        state = None
                    yield step
    finally:
        await background.run(remove_folder, scratch)


async def _step_backward(
    engine: DepthEngine,
    sequence: StereoSource,
    config: StreamConfig,
    scratch: Path,
    *,
    first: int,
    end: int,
    owner: str,
) -> None:
    """Step the frames before ``end`` backward to ``first``, and keep their maps in ``scratch``."""
    last = min(end + _LEAD, len(sequence)) - 1
    backward = _backward(sequence, first, last)

    def may_skip(error: DatasetError | DepthError) -> bool:
        return disk_trouble(error) is None  # the pass forward reports the others

    def keep(step: Stepped) -> None:
        index = last - step.index
        if index < end:
            record = FrameRecord(index=index, left="", right="", capture_ns=0)
            content = encode_frame(record, step.make_map(), sigma=True)
            _path(scratch, index).write_bytes(content)

    stepping = step_all(engine, backward, config, may_skip=may_skip, owner=owner)
    async with aclosing(stepping) as steps:
        async for step in steps:
            if isinstance(step, Stepped):
                await engine.threads.background.run(keep, step)


def _backward(sequence: StereoSource, first: int, last: int) -> StereoSource:
    """Return the frames from ``last`` down to ``first``; their times increase all the same."""
    chosen = sequence.files[first : last + 1]
    latest_ns = max(each.capture_ns for each in chosen)
    files = [
        dataclasses.replace(each, capture_ns=latest_ns - each.capture_ns, read_truth=None)
        for each in reversed(chosen)
    ]
    return dataclasses.replace(sequence, files=files)


def _read(path: Path) -> bytes | None:
    return path.read_bytes() if path.is_file() else None


def _fused(step: Stepped, backward: bytes | None) -> DisparityMap:
    others = [] if step.make_alone is None else [step.make_alone()]
    if backward is not None:
        found = decode_frame(backward, step.rectifier.rig).disparity
        others += [] if found is None else [found]
    return fused(step.make_map(), others)


def _path(scratch: Path, index: int) -> Path:
    return scratch / f"{index:06d}{SUFFIX}"


def why_no_passes(sequence: StereoSource, card: ModelCard) -> str | None:
    """Return why more passes would change nothing, or None if they help."""
    if not card.recurrent:
        return f"the model {card.name} has no memory from frame to frame"
    if len(sequence) == 1:
        return "the sequence is one frame"
    if all(each.world_from_left is None for each in sequence.files):
        return "no frame has a pose"
    return None
