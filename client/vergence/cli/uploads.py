"""Uploads of ``vergence batch``: archives as they are, folders packed into archives."""

import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from vergence.cli.errors import CliError
from vergence_proto.datasets import DATASETS, DatasetError, find_sources
from vergence_proto.datasets.listing import found

_ARCHIVES = (".zip", ".tar", ".tar.gz", ".tgz", ".tar.xz", ".txz", ".tar.bz2", ".tbz2")
_OWN_LAYOUT = "vergence"


@dataclass(frozen=True, slots=True)
class Upload:
    """One sequence and its location."""

    name: str  # the name of the results, unique in a batch
    path: Path  # an archive, or a folder to pack
    source: str | None = None  # KIND:PATH inside the archive; None: the server finds it

    def pack(self, scratch: Path) -> Path:
        """Return the archive to send; it stores files, since images are compressed already."""
        if self.path.is_file():
            return self.path
        archive = scratch / f"{self.name}.zip"
        # A file system may state a time before 1980, which the format cannot.
        with zipfile.ZipFile(archive, "w", strict_timestamps=False) as file:
            for each in found(self.path, "*"):
                if each.is_file():
                    file.write(each, each.relative_to(self.path))
        return archive


def find_uploads(paths: list[Path]) -> list[Upload]:
    """Find the sequences at ``paths``: archives, folders of one, or of many in Vergence's layout.

    Raises CliError: a path is neither, or contains no sequence.
    """
    taken: set[str] = set()
    return [
        Upload(_unique(upload.name, taken), upload.path, upload.source)
        for path in paths
        for upload in _at(path)
    ]


def _at(path: Path) -> Iterator[Upload]:
    suffix = next((each for each in _ARCHIVES if path.name.lower().endswith(each)), None)
    if path.is_file() and suffix is not None:
        yield Upload(path.name[: -len(suffix)] or path.name, path)
        return
    if not path.is_dir():
        raise CliError(
            f"{path}: expected a folder, or an archive ({' '.join(_ARCHIVES)})", exit_code=2
        )
    own = _found(_OWN_LAYOUT, path)
    if own:
        for folder in own:
            yield Upload(folder.name or path.resolve().name, folder)
        return
    others = [(kind, each) for kind in DATASETS for each in _found(kind, path)]
    if not others:
        raise CliError(f"{path}: no sequence in {', '.join(DATASETS)} layout", exit_code=2)
    if len(others) > 1:
        named = ", ".join(f"{kind}:{each}" for kind, each in others[:8])
        raise CliError(
            f"{path}: more than one sequence ({named}); name folders that hold one", exit_code=2
        )
    kind, folder = others[0]
    yield Upload(folder.name or path.resolve().name, path, f"{kind}:{folder.relative_to(path)}")


def _found(kind: str, path: Path) -> list[Path]:
    try:
        specs = find_sources(f"{kind}:{path}")
    except DatasetError as error:
        raise CliError(str(error), exit_code=2) from None
    return [Path(spec.partition(":")[2]) for spec in specs]


def _unique(name: str, taken: set[str]) -> str:
    candidate, number = name, 1
    while candidate in taken:
        number += 1
        candidate = f"{name}-{number}"
    taken.add(candidate)
    return candidate
