"""What ``vergence batch`` sends: archives, folders of one sequence, or folders of many."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from vergence.cli.errors import CliError
from vergence.jobs.packing import ARCHIVES, Upload
from vergence_proto.datasets import DATASETS, DatasetError, find_sources

_OWN_LAYOUT = "vergence"


@dataclass(frozen=True, slots=True)
class NamedUpload:
    """One sequence and the name of its result, unique in a batch."""

    name: str
    upload: Upload


def find_uploads(paths: list[Path]) -> list[NamedUpload]:
    """Find the sequences at ``paths``: archives, folders of one, or of many in Vergence's layout.

    Raises CliError: a path is neither, or contains no sequence.
    """
    taken: set[str] = set()
    return [
        NamedUpload(_unique(each.name, taken), each.upload) for path in paths for each in _at(path)
    ]


def _at(path: Path) -> Iterator[NamedUpload]:
    suffix = next((each for each in ARCHIVES if path.name.lower().endswith(each)), None)
    if path.is_file() and suffix is not None:
        yield NamedUpload(path.name[: -len(suffix)] or path.name, Upload(path))
        return
    if not path.is_dir():
        raise CliError(
            f"{path}: expected a folder, or an archive ({' '.join(ARCHIVES)})", exit_code=2
        )
    own = _found(_OWN_LAYOUT, path)
    if own:
        for folder in own:
            yield NamedUpload(folder.name or path.resolve().name, Upload(folder))
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
    source = f"{kind}:{folder.relative_to(path)}"
    yield NamedUpload(folder.name or path.resolve().name, Upload(path, source))


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
