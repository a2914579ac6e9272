"""Small files read with care, and the one error of every reader."""

import json
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

JsonObject = Mapping[str, object]


class LayoutError(ValueError):
    """A file is missing, damaged, or not what its layout says; the message names it."""


def existing(path: Path, purpose: str) -> Path:
    """Raises LayoutError: there is no such file."""
    if not path.is_file():
        raise LayoutError(f"{path}: not found; expected {purpose}")
    return path


def read_text(path: Path, purpose: str) -> str:
    """Raises LayoutError: there is no such file, or it is not text."""
    try:
        return existing(path, purpose).read_text("utf-8")
    except UnicodeDecodeError:
        raise LayoutError(f"{path}: expected text, {purpose}") from None


def numbers(words: str, count: int | None, origin: str) -> list[float]:
    """Parse numbers split by blanks or commas.

    Raises LayoutError: a word that is no number, or another count than ``count``.
    """
    try:
        parsed = [float(word) for word in words.replace(",", " ").split()]
    except ValueError as error:
        raise LayoutError(f"{origin}: {error}") from None
    if count is not None and len(parsed) != count:
        raise LayoutError(f"{origin}: expected {count} numbers, got {len(parsed)}")
    return parsed


def read_object(path: Path, purpose: str) -> JsonObject:
    """Raises LayoutError: there is no such file, or no JSON object in it."""
    try:
        read = json.loads(read_text(path, purpose))
    except json.JSONDecodeError as error:
        raise LayoutError(f"{path}: not JSON: {error}") from None
    if not isinstance(read, dict):
        raise LayoutError(f"{path}: expected a JSON object, got {type(read).__name__}")
    return read


def object_number(path: Path, read: JsonObject, key: str) -> float:
    """Raises LayoutError: what :func:`read_object` read has no number under ``key``."""
    value = read.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise LayoutError(f"{path}: expected a number for {key!r}, got {value!r}")
    return float(value)


def npz_arrays(path: Path, *names: str) -> Mapping[str, NDArray[Any]]:
    """Read a whole .npz. Raises LayoutError: damaged, or without one of ``names``."""
    # Opened here, because np.load leaves a damaged file open.
    with existing(path, "an .npz").open("rb") as file:
        arrays = _loaded(path, file)
    for name in names:
        if name not in arrays:
            raise LayoutError(f"{path}: expected an array {name!r}, got {', '.join(arrays)}")
    return arrays


def _loaded(path: Path, file: BinaryIO) -> Mapping[str, NDArray[Any]]:
    try:
        with np.load(file) as archive:
            return dict(archive)
    except (ValueError, EOFError, OSError, zipfile.BadZipFile, zlib.error) as error:
        raise LayoutError(f"{path}: no readable .npz: {error}") from None
