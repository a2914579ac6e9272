"""Find and open the sequence in the folder of an upload.

A *source* is text, KIND:PATH, as clients write it. A *sequence* is an opened source.
"""

from pathlib import Path

from vergence_proto.datasets import (
    DATASETS,
    DatasetError,
    StereoSource,
    find_sources,
    open_source,
)
from vergence_proto.errors import BadSequence

_NAMED_AT_MOST = 12
_TRIED = 8  # frames


def find_sequence(folder: Path, source: str | None) -> tuple[str, StereoSource]:
    """Find the sequence below ``folder``; return its source and the opened sequence.

    Raises BadSequence if the source cannot be opened, or if there is no source and ``folder`` does
    not contain exactly one sequence.
    """
    if source is not None:
        return source, open_below(folder, source)
    found: list[tuple[str, StereoSource]] = []
    trouble: list[str] = []
    for kind in DATASETS:
        for spec in find_sources(f"{kind}:{folder}"):
            try:
                found.append((relative_text(spec, folder), open_source(spec)))
            except DatasetError as error:
                trouble.append(relative_text(str(error), folder))
    if not found:
        why = f" ({trouble[0]})" if trouble else ""
        raise BadSequence(f"expected a sequence in one of {', '.join(DATASETS)}, found none{why}")
    if len(found) > 1:
        named = ", ".join(source for source, _ in found[:_NAMED_AT_MOST])
        raise BadSequence(f"expected one sequence; choose one with source=KIND:PATH: {named}")
    return _not_empty(*found[0])


def open_below(folder: Path, source: str) -> StereoSource:
    """Open KIND:PATH below ``folder``.

    Raises BadSequence if the path leads out of the folder, if the files there are not a sequence of
    this kind, or if it has no frames.
    """
    kind, _, path = source.partition(":")
    if not (folder / path.partition("?")[0]).resolve().is_relative_to(folder.resolve()):
        raise BadSequence(f"expected a path below the upload's own folder, got {source!r}")
    try:
        sequence = open_source(f"{kind}:{folder}/{path}" if path else f"{kind}:{folder}")
    except DatasetError as error:
        raise sequence_error(error, folder) from None
    return _not_empty(source, sequence)[1]


def _not_empty(source: str, sequence: StereoSource) -> tuple[str, StereoSource]:
    if len(sequence) == 0:
        raise BadSequence(f"{source}: no frames")
    return source, sequence


def check_readable(sequence: StereoSource, folder: Path) -> None:
    """Raise BadSequence if none of the first frames can be read: the job would have no result."""
    first_error: DatasetError | None = None
    for index in range(min(len(sequence), _TRIED)):
        try:
            sequence.without_truth()[index]
        except DatasetError as error:
            first_error = first_error or error
        else:
            return
    if first_error is not None:
        raise sequence_error(first_error, folder) from None


def missing_images(sequence: StereoSource, folder: Path) -> list[str]:
    """Name the images that a sequence lists and that are not there."""
    return [f"{relative_text(str(path), folder)}: not found" for path in sequence.missing_images]


def sequence_error(error: DatasetError, folder: Path) -> BadSequence:
    """Return the error about a file below ``folder``, without the server's own path."""
    return BadSequence(relative_text(str(error), folder))


def relative_text(text: str, folder: Path) -> str:
    """Return text about files below ``folder``, without the server's own path."""
    return text.replace(f"{folder}/", "").replace(str(folder), "")
