"""Sequences in folders of the server's machine: they need no upload and no copy.

The operator names the folders. A job has a link to its sequence in place of an upload.
"""

from collections.abc import Sequence
from pathlib import Path

from vergence_proto.errors import BadSequence

_KIND = "file:"


class FolderInputs:
    """The folders that the operator has named, as ``NAME=PATH``."""

    def __init__(self, named: Sequence[str]) -> None:
        parts = (each.partition("=") for each in named)
        self._folders = {name: Path(path) for name, _, path in parts}

    def find(self, stated: str) -> Path:
        """Return the folder of ``file:NAME/PATH``.

        Raises BadSequence: it is not there, or leads out of the named folder.
        """
        if not self._folders:
            raise BadSequence(
                "this server reads no folders; its operator can name some with the setting "
                "batch.inputs"
            )
        name, _, path = stated.removeprefix(_KIND).partition("/")
        base = self._folders.get(name)
        if not stated.startswith(_KIND) or base is None:
            known = ", ".join(sorted(self._folders))
            raise BadSequence(
                f"expected an input of file:NAME/PATH, NAME one of {known}, got {stated[:100]!r}"
            )
        try:
            found = (base / path).resolve()  # ValueError: a null character
            if found.is_relative_to(base.resolve()) and found.is_dir():
                return found
        except (OSError, ValueError):
            pass
        raise BadSequence(f"no folder {stated[:100]!r}")
