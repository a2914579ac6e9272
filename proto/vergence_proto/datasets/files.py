"""Checked reading of small files, and the error that every reader raises."""

import json
import re
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from vergence_proto.text import decoded_text

JsonObject = Mapping[str, object]

_TRAILING_COMMA = re.compile(r",(\s*[}\]])")  # of lists that were edited by hand


class DatasetError(ValueError):
    """A file of a data set is missing, damaged, or unexpected; the message names it."""


def existing(path: Path, purpose: str) -> Path:
    """Return ``path``. Raises DatasetError: there is no such file."""
    if not path.is_file():
        raise DatasetError(f"{path}: not found; expected {purpose}")
    return path


def read_text(path: Path, purpose: str) -> str:
    """Read text of any encoding that :func:`~vergence_proto.text.decoded_text` knows.

    Raises DatasetError: there is no such file, or it is not text.
    """
    text = decoded_text(existing(path, purpose).read_bytes())
    if text is None:
        raise DatasetError(f"{path}: expected text, {purpose}")
    return text


def read_lines(path: Path, purpose: str) -> list[str]:
    """Read the lines that are neither blank nor a comment (``#``), without surrounding blanks.

    Raises DatasetError: there is no such file, or it is not text.
    """
    lines = (line.strip() for line in read_text(path, purpose).splitlines())
    return [line for line in lines if line and not line.startswith("#")]


def numbers(words: str, count: int | None, origin: str) -> list[float]:
    """Parse numbers separated by blanks or commas.

    Raises DatasetError: a word is no number, or there are not ``count`` numbers.
    """
    try:
        parsed = [float(word) for word in words.replace(",", " ").split()]
    except ValueError as error:
        raise DatasetError(f"{origin}: {error}") from None
    if count is not None and len(parsed) != count:
        raise DatasetError(f"{origin}: expected {count} numbers, got {len(parsed)}")
    return parsed


def read_object(path: Path, purpose: str) -> JsonObject:
    """Read a JSON object. Raises DatasetError: there is no such file, or it holds none."""
    text = read_text(path, purpose)
    try:
        read = json.loads(_TRAILING_COMMA.sub(r"\1", text))
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{path}: not JSON: {error}") from None
    if not isinstance(read, dict):
        raise DatasetError(f"{path}: expected a JSON object, got {type(read).__name__}")
    return read


def object_number(path: Path, read: JsonObject, key: str) -> float:
    """Return the number under ``key`` of what :func:`read_object` read.

    Raises DatasetError: there is no number under ``key``.
    """
    value = read.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise DatasetError(f"{path}: expected a number for {key!r}, got {value!r}")
    return float(value)


def npz_arrays(path: Path, *names: str) -> Mapping[str, NDArray[Any]]:
    """Read a whole .npz. Raises DatasetError: it is damaged, or lacks one of ``names``."""
    # The file is opened here, because np.load leaves a damaged file open.
    with existing(path, "an .npz").open("rb") as file:
        arrays = _loaded(path, file)
    for name in names:
        if name not in arrays:
            raise DatasetError(f"{path}: expected an array {name!r}, got {', '.join(arrays)}")
    return arrays


def _loaded(path: Path, file: BinaryIO) -> Mapping[str, NDArray[Any]]:
    try:
        with np.load(file) as archive:
            return dict(archive)
    except (ValueError, EOFError, OSError, zipfile.BadZipFile, zlib.error) as error:
        raise DatasetError(f"{path}: expected a readable .npz: {error}") from None
