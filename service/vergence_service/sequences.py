"""A whole sequence as one pure function of its frames and the model, and where to find one."""

import asyncio
import dataclasses
from collections import deque
from collections.abc import AsyncGenerator
from dataclasses import dataclass
from pathlib import Path

from vergence_proto.errors import BadSequence
from vergence_proto.layouts import (
    LAYOUTS,
    LayoutError,
    SourceFrame,
    StereoSource,
    find_sources,
    open_source,
    read_ahead,
)
from vergence_proto.types import DisparityMap
from vergence_service.engine import DepthEngine
from vergence_service.model import RecurrentState
from vergence_service.streams import Opening, Stream

# One step is in the model while the answer of the one before is made ready.
_IN_FLIGHT = 2
_NAMED_AT_MOST = 12


@dataclass(frozen=True, slots=True, eq=False)
class Stepped:
    """One frame of a sequence and what came of it."""

    index: int  # from 0
    source: SourceFrame
    disparity: DisparityMap
    state: RecurrentState  # that it left


async def step_all(
    engine: DepthEngine,
    source: StereoSource,
    opening: Opening,
    *,
    start: int = 0,
    state: RecurrentState | None = None,
) -> AsyncGenerator[Stepped, None]:
    """Every frame of ``source`` in order, each on the state that its predecessor left.

    Or every one from ``start`` on, whose predecessor left ``state``.

    Raises what DepthEngine.open_apart and step_apart raise; LayoutError: a file cannot be read.
    """
    stream = await engine.open_apart(opening, state=state)
    frames = read_ahead(source, start=start)
    waiting: deque[asyncio.Task[Stepped]] = deque()
    try:
        async for index, frame in frames:
            if len(waiting) == _IN_FLIGHT:
                yield await waiting.popleft()
            waiting.append(asyncio.create_task(_step(engine, stream, index, frame)))
        while waiting:
            yield await waiting.popleft()
    finally:
        for task in waiting:
            task.cancel()
        await asyncio.gather(*waiting, frames.aclose(), return_exceptions=True)


async def _step(engine: DepthEngine, stream: Stream, index: int, source: SourceFrame) -> Stepped:
    disparity, state = await engine.step_apart(stream, lambda: source.frame)
    return Stepped(index, source, disparity, state)


def without_truth(source: StereoSource) -> StereoSource:
    """The same frames, without the time that it takes to read what is known about them."""
    files = [dataclasses.replace(each, read_truth=None) for each in source.files]
    return dataclasses.replace(source, files=files)


def find_sequence(folder: Path, wanted: str | None) -> str:
    """The one source in or under ``folder``, or the ``wanted`` one, as KIND:PATH below it.

    Raises BadSequence: there is none, there are several and none is wanted, or it is damaged.
    """
    if wanted is not None:
        open_below(folder, wanted)
        return wanted
    found, trouble = [], []
    for kind in LAYOUTS:
        for spec in find_sources(f"{kind}:{folder}"):
            try:
                open_source(spec)
            except LayoutError as error:
                trouble.append(_relative(str(error), folder))
            else:
                found.append(_relative(spec, folder))
    if not found:
        why = f" ({trouble[0]})" if trouble else ""
        raise BadSequence(f"expected a sequence in one of {', '.join(LAYOUTS)}, found none{why}")
    if len(found) > 1:
        named = ", ".join(found[:_NAMED_AT_MOST])
        raise BadSequence(f"expected one sequence; take one with source=KIND:PATH: {named}")
    return found[0]


def open_below(folder: Path, spec: str) -> StereoSource:
    """Open KIND:PATH below ``folder``.

    Raises BadSequence: it leads out of the folder, has no frames, or as
    :func:`vergence_proto.layouts.open_source`.
    """
    kind, _, path = spec.partition(":")
    if not (folder / path.partition("?")[0]).resolve().is_relative_to(folder.resolve()):
        raise BadSequence(f"expected a path below the upload's own folder, got {spec!r}")
    try:
        source = open_source(f"{kind}:{folder}/{path}" if path else f"{kind}:{folder}")
    except LayoutError as error:
        raise sequence_error(error, folder) from None
    if len(source) == 0:
        raise BadSequence(f"{spec}: no frames")
    return source


def sequence_error(error: LayoutError, folder: Path) -> BadSequence:
    """What was wrong with a file below ``folder``, without saying where the server keeps it."""
    return BadSequence(_relative(str(error), folder))


def _relative(text: str, folder: Path) -> str:
    return text.replace(f"{folder}/", "").replace(str(folder), "")
