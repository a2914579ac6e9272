"""Folders and text files, with the bytes and names that Windows and macOS add.

A name that starts with a dot and a ``__MACOSX`` folder are no data. A text file may start with a
byte order mark and end its lines with CR LF.
"""

import re
from collections.abc import Mapping
from pathlib import Path

from vergence_proto.datasets.files import DatasetError, existing, numbers

IMAGES = (".png", ".jpg", ".jpeg", ".webp", ".ppm", ".pgm")


def found(root: Path, pattern: str) -> list[Path]:
    """List every data file or folder in or under ``root`` that matches ``pattern``, sorted."""
    return sorted(path for path in root.rglob(pattern) if _is_data(path.relative_to(root)))


def images(folder: Path, name: str = r".*\d") -> list[Path]:
    """The images in ``folder`` whose name without its suffix is like ``name``; 9 before 10."""
    if not folder.is_dir():
        return []
    matching = re.compile(name)
    return sorted(
        (
            path
            for path in folder.iterdir()
            if _is_data(Path(path.name))
            and path.suffix.lower() in IMAGES
            and matching.fullmatch(path.stem)
        ),
        key=lambda path: (_words(path.stem), path.name),
    )


def image_beside(path: Path, folder: Path, name: str) -> Path:
    """The image ``name`` in ``folder``, with the suffix of ``path`` or any other that is there."""
    own = folder / f"{name}{path.suffix}"
    others = (folder / f"{name}{suffix}" for suffix in IMAGES)
    return next((each for each in (own, *others) if each.is_file()), own)


def number_in(path: Path) -> int:
    """The last number in a file's name.

    Raises DatasetError: there is none.
    """
    digits = re.findall(r"\d+", path.stem)
    if not digits:
        raise DatasetError(f"{path}: expected a name with a frame number, got {path.name!r}")
    return int(digits[-1])


def read_lines(path: Path, purpose: str) -> list[str]:
    """Read the lines that are not blank.

    Raises DatasetError: there is no such file, or it is not text.
    """
    try:
        text = existing(path, purpose).read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError:
        raise DatasetError(f"{path}: expected text, {purpose}") from None
    return [line.strip() for line in text.splitlines() if line.strip()]


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


def _is_data(path: Path) -> bool:
    return not any(part.startswith(".") or part == "__MACOSX" for part in path.parts)


def _words(name: str) -> list[tuple[str, int]]:
    """The name's words and numbers, so that numbers compare by value."""
    return [(word, int(digits or -1)) for word, digits in re.findall(r"(\D*)(\d*)", name)]
