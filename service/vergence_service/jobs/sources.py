"""Find and open the sequence in an upload's folder."""

import dataclasses
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
    for kind in DATASETS:
        for spec in find_sources(f"{kind}:{folder}"):
            try:
                open_source(spec)
            except DatasetError as error:
                trouble.append(_relative(str(error), folder))
            else:
                found.append(_relative(spec, folder))
    if not found:
        why = f" ({trouble[0]})" if trouble else ""
        raise BadSequence(f"expected a sequence in one of {', '.join(DATASETS)}, found none{why}")
    if len(found) > 1:
        named = ", ".join(found[:_NAMED_AT_MOST])
        raise BadSequence(f"expected one sequence; take one with source=KIND:PATH: {named}")
    return found[0]


def open_below(folder: Path, spec: str) -> StereoSource:
    """Open KIND:PATH below ``folder``.

    Raises BadSequence: it leads out of the folder, has no frames, or as
    :func:`vergence_proto.datasets.open_source`.
    """
    kind, _, path = spec.partition(":")
    if not (folder / path.partition("?")[0]).resolve().is_relative_to(folder.resolve()):
        raise BadSequence(f"expected a path below the upload's own folder, got {spec!r}")
    try:
        source = open_source(f"{kind}:{folder}/{path}" if path else f"{kind}:{folder}")
    except DatasetError as error:
        raise sequence_error(error, folder) from None
    if len(source) == 0:
        raise BadSequence(f"{spec}: no frames")
    return source


def sequence_error(error: DatasetError, folder: Path) -> BadSequence:
    """What was wrong with a file below ``folder``, without saying where the server keeps it."""
    return BadSequence(_relative(str(error), folder))


def _relative(text: str, folder: Path) -> str:
    return text.replace(f"{folder}/", "").replace(str(folder), "")
