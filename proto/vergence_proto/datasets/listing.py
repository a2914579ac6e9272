"""Folders and tables, with the names that Windows and macOS add.

A name that starts with a dot and a ``__MACOSX`` folder are no data. The suffix of an image may be
written in capitals. Links to folders are followed.
"""

import fnmatch
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path, PurePath
from typing import TypeVar

from vergence_proto.datasets.files import DatasetError, numbers, read_lines

Row = TypeVar("Row")

IMAGES = (".png", ".jpg", ".jpeg", ".webp", ".ppm", ".pgm")


def found(root: Path, pattern: str) -> list[Path]:
    """List every data file or folder in or under ``root`` that matches ``pattern``, sorted."""
    name = re.compile(fnmatch.translate(PurePath(pattern).name))
    below = (path for path in _below(root, (os.path.realpath(root),)) if name.match(path.name))
    return sorted(path for path in below if path.relative_to(root).match(pattern))


def images(folder: Path, name: str = r".*\d") -> list[Path]:
    """The images in ``folder`` whose name without its suffix is like ``name``; 9 before 10."""
    if not folder.is_dir():
        return []
    matching = re.compile(name)
    return sorted(
        (
            path
            for path in folder.iterdir()
            if is_data(path.name)
            and path.suffix.lower() in IMAGES
            and matching.fullmatch(path.stem)
        ),
        key=lambda path: (_words(path.stem), path.name),
    )


def image_beside(path: Path, folder: Path, name: str) -> Path:
    """The image ``name`` in ``folder``, with the suffix of ``path`` or any other that is there."""
    own = folder / f"{name}{path.suffix}"
    suffixes = (each for suffix in IMAGES for each in (suffix, suffix.upper()))
    others = (folder / f"{name}{suffix}" for suffix in suffixes)
    return next((each for each in (own, *others) if each.is_file()), own)


def number_in(path: Path) -> int:
    """The last number in a file's name.

    Raises DatasetError: there is none.
    """
    digits = re.findall(r"\d+", path.stem)
    if not digits:
        raise DatasetError(f"{path}: expected a name with a frame number, got {path.name!r}")
    return int(digits[-1])


def read_rows(path: Path, count: int, purpose: str) -> list[list[float]]:
    """Read ``count`` numbers per line; a first line of words is a heading.

    Raises DatasetError: there is no such file, a line of words, or another count.
    """
    lines = read_lines(path, purpose)
    heading = bool(lines) and lines[0][0].isalpha()
    return [
        numbers(line, count, f"{path}, line {number}")
        for number, line in enumerate(lines, start=1)
        if not (heading and number == 1)
    ]


def read_keyed(path: Path, purpose: str, **counts: int) -> Mapping[str, list[float]]:
    """Read the lines ``KEY: numbers`` of the named keys; a key without a line is left out.

    Raises DatasetError: there is no such file, or another count of numbers.
    """
    keyed = {}
    for line in read_lines(path, purpose):
        key, colon, rest = line.partition(":")
        if colon and key.strip() in counts:
            keyed[key.strip()] = numbers(rest, counts[key.strip()], f"{path}, {key.strip()}")
    return keyed


def rows_of_frames(rows: Sequence[Row], numbers: Sequence[int]) -> list[Row | None]:
    """Match the rows of a file with the frames of these numbers; None: no row belongs to a frame.

    As many rows as frames belong to them in order. Otherwise row ``n``, counted from 0, belongs to
    frame ``n``: of a longer sequence only some frames may be here.
    """
    if len(rows) == len(numbers):
        return list(rows)
    return [rows[number] if number < len(rows) else None for number in numbers]


def notes_on_poses(path: Path, poses: Sequence[object | None]) -> tuple[str, ...]:
    """Return what a user should know about frames without a pose, though ``path`` has poses."""
    without = sum(pose is None for pose in poses)
    if not without:
        return ()
    return (f"{path} has no pose for {without} of {len(poses)} frames, which start cold",)


def is_data(name: str) -> bool:
    """Decide whether a file or folder belongs to the data, and was not added by a system."""
    return not (name.startswith(".") or name == "__MACOSX")


def _below(folder: Path, inside: tuple[str, ...]) -> Iterator[Path]:
    """Yield what is below ``folder``; ``inside`` are the real folders that lead to it."""
    with suppress(OSError), os.scandir(folder) as entries:  # OSError: a folder of somebody else
        for entry in entries:
            if is_data(entry.name):
                yield Path(entry.path)
                if entry.is_dir():
                    real = os.path.realpath(entry.path)
                    if real not in inside:  # a link may lead back
                        yield from _below(Path(entry.path), (*inside, real))


def _words(name: str) -> list[tuple[str, int]]:
    """The name's words and numbers, so that numbers compare by value."""
    return [(word, int(digits or -1)) for word, digits in re.findall(r"(\D*)(\d*)", name)]
