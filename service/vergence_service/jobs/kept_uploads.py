"""Uploads that arrive in parts, on disk: they survive lost connections and restarts.

::

    DIRECTORY/uploads/ID/body        what has arrived
    DIRECTORY/uploads/ID/about.json  the length that was announced, and the owner
"""

import json
import secrets
import shutil
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from vergence_proto.errors import UnknownSequence
from vergence_service.access.principals import Principal

_BODY, _ABOUT = "body", "about.json"
# An announcement keeps room for so long after the last byte: it costs its client nothing.
_GOES_ON_S = 600.0
_UNFINISHED = "."  # the beginning of the name of a folder that is being made


@dataclass(frozen=True, slots=True)
class KeptUpload:
    """An upload, complete or not."""

    upload_id: str
    owner: str
    path: Path  # of its bytes
    length: int  # bytes that were announced
    offset: int  # bytes that have arrived
    expires_s: float  # Unix time


class KeptUploads:
    """The uploads of one server. All methods block; any thread may call them."""

    def __init__(self, directory: Path, *, keep_s: float) -> None:
        self._directory = directory
        self._keep_s = keep_s

    def create(self, owner: Principal, length: int) -> KeptUpload:
        """Make an empty upload of ``length`` bytes."""
        self.expire()
        folder = self._directory / secrets.token_hex(16)
        # Renamed when it is whole: another thread that expires uploads sees all of it or nothing.
        unfinished = folder.with_name(f"{_UNFINISHED}{folder.name}")
        unfinished.mkdir(parents=True, mode=0o700)
        (unfinished / _BODY).touch()
        (unfinished / _ABOUT).write_text(json.dumps({"length": length, "owner": owner.name}))
        unfinished.rename(folder)
        return self._read(folder)

    def get(self, upload_id: str, caller: Principal) -> KeptUpload:
        """Return an upload of the caller. Raises UnknownSequence: there is none, or no longer."""
        folder = self._directory / upload_id
        try:
            if upload_id.isalnum() and caller.owns(
                json.loads((folder / _ABOUT).read_text())["owner"]
            ):
                upload = self._read(folder)
                if upload.expires_s > time.time():
                    return upload
        except (OSError, ValueError, KeyError):
            pass
        raise UnknownSequence(
            f"no upload {upload_id[:64]!r}: it never existed, was deleted or submitted, or expired"
        )

    def ids(self) -> list[str]:
        """Return the ids of all uploads."""
        return [each.upload_id for each in self._all()]

    def has(self, upload_id: str) -> bool:
        """Check for an upload of anybody."""
        return upload_id.isalnum() and (self._directory / upload_id).is_dir()

    def held_bytes(self, besides: str = "", owner: str | None = None) -> int:
        """Return the space that uploads take, without the one of the id ``besides``.

        It is what was announced, as long as the upload goes on, and then what has arrived.
        ``owner``: only of uploads of this principal.
        """
        return sum(
            each.offset + self._missing(each)
            for each in self._all()
            if each.upload_id != besides and owner in (None, each.owner)
        )

    def missing_bytes(self) -> int:
        """Return the space that uploads which go on have announced and do not use yet."""
        return sum(map(self._missing, self._all()))

    def _missing(self, upload: KeptUpload) -> int:
        silent_s = time.time() - (upload.expires_s - self._keep_s)
        return upload.length - upload.offset if silent_s < _GOES_ON_S else 0

    def _all(self) -> Iterator[KeptUpload]:
        for folder in self._directory.iterdir() if self._directory.is_dir() else ():
            with suppress(OSError, ValueError, KeyError):  # deleted meanwhile, or damaged
                yield self._read(folder)

    def delete(self, upload_id: str) -> None:
        """Delete an upload that exists."""
        shutil.rmtree(self._directory / upload_id, ignore_errors=True)

    def expire(self) -> float | None:
        """Delete the uploads to which nothing was added for too long.

        Returns the time in seconds until the next one expires, None if there is none.
        """
        waits_s: list[float] = []
        for folder in self._directory.iterdir() if self._directory.is_dir() else ():
            try:
                if folder.name.startswith(_UNFINISHED):  # of a crash, if it stays so
                    expires_s = folder.stat().st_mtime + self._keep_s
                else:
                    expires_s = self._read(folder).expires_s
            except (OSError, ValueError, KeyError):  # deleted meanwhile, or damaged
                expires_s = 0.0
            if (wait_s := expires_s - time.time()) > 0:
                waits_s.append(wait_s)
            else:
                shutil.rmtree(folder, ignore_errors=True)
        return min(waits_s, default=None)

    def _read(self, folder: Path) -> KeptUpload:
        body = (folder / _BODY).stat()
        about = json.loads((folder / _ABOUT).read_text())
        return KeptUpload(
            folder.name,
            str(about["owner"]),
            folder / _BODY,
            int(about["length"]),
            body.st_size,
            body.st_mtime + self._keep_s,
        )
