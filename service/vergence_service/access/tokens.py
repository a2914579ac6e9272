"""Bearer tokens: a file of their hashes, which is read again when it changes.

::

    ["sha256:9f86d081884c7d65..."]
    principal = "ana"
    role = "user"       # or "admin"
    streams = 4         # most open streams; without it, the server's limit
    weight = 1.0        # share of the machine

A token has 32 random bytes, so a plain hash is as good as a slow one.
"""

import hashlib
import json
import logging
import os
import secrets
import tempfile
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from vergence_service.access.principals import Principal, Role, checked_name

log = logging.getLogger(__name__)

_PREFIX = "sha256:"
_HEADER = "# Tokens of a Vergence server, as hashes. `vergence token` changes this file.\n"


class TokenFileError(ValueError):
    """The file of tokens cannot be read, or has other contents than expected."""


def digest_of(token: str) -> str:
    """Return the digest under which the file keeps a token."""
    return _PREFIX + hashlib.sha256(token.encode()).hexdigest()


def new_token() -> str:
    """Return a new token."""
    return f"vrg_{secrets.token_urlsafe(32)}"


def read_tokens(path: Path) -> dict[str, Principal]:
    """Return the principal of each digest. Raises TokenFileError."""
    try:
        document = tomllib.loads(path.read_text("utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        why = getattr(error, "strerror", None) or error
        raise TokenFileError(f"cannot read the tokens in {path}: {why}") from None
    return {digest: _principal(path, digest, entry) for digest, entry in document.items()}


def write_tokens(path: Path, tokens: Mapping[str, Principal]) -> None:
    """Replace the file at once, so that a server reads either the old or the new one."""
    lines = [_HEADER]
    for digest, each in tokens.items():
        lines.append(f'["{digest}"]\nprincipal = {json.dumps(each.name)}\nrole = "{each.role}"\n')
        if each.streams is not None:
            lines.append(f"streams = {each.streams}\n")
        if each.weight != 1:
            lines.append(f"weight = {each.weight}\n")
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(  # its mode is 0600
        "w", encoding="utf-8", dir=path.parent, prefix=path.name, delete=False
    ) as file:
        file.write("".join(lines))
    os.replace(file.name, path)


class Tokens:
    """The tokens of a file. :meth:`reload` reads it if it has changed."""

    def __init__(self, path: Path) -> None:
        """Read the file. Raises TokenFileError."""
        self._path = path
        self._seen = _version(path)
        self._by_digest = read_tokens(path)

    def principal_of(self, token: str) -> Principal | None:
        """Return the principal of a token, or None if the file does not have it."""
        return self._by_digest.get(digest_of(token))

    def names(self) -> frozenset[str]:
        """Return the names of all principals that have a token."""
        return frozenset(each.name for each in self._by_digest.values())

    def valid(self, credential: str) -> bool:
        """Return True if the file has the token of this digest."""
        return credential in self._by_digest

    def reload(self) -> bool:
        """Read the file if it has changed, and return True if it has.

        A file with errors changes nothing, and the log says why. A file that was removed has no
        tokens.
        """
        seen = _version(self._path)
        if seen == self._seen:
            return False
        self._seen = seen
        try:
            self._by_digest = read_tokens(self._path) if seen else {}
        except TokenFileError as error:
            log.error("the tokens stay as they were: %s", error)
            return False
        log.info("read %d tokens from %s", len(self._by_digest), self._path)
        return True


def _version(path: Path) -> tuple[int, int, int] | None:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size, status.st_ino


def _principal(path: Path, digest: str, entry: Any) -> Principal:
    try:
        if not digest.startswith(_PREFIX) or len(digest) != len(_PREFIX) + 64:
            raise ValueError(f"expected a key sha256:HEX, got {digest[:80]!r}")
        if not isinstance(entry, dict) or not isinstance(entry.get("principal"), str):
            raise ValueError("expected a table with the name of a principal")
        if unknown := set(entry) - {"principal", "role", "streams", "weight"}:
            raise ValueError(f"unknown keys {sorted(unknown)}")
        principal = Principal(
            checked_name(entry["principal"]), Role(entry.get("role", "user")), credential=digest
        )
        streams, weight = entry.get("streams"), entry.get("weight", 1.0)
        if streams is not None and (not isinstance(streams, int) or streams < 1):
            raise ValueError(f"expected streams above 0, got {streams!r}")
        if not isinstance(weight, int | float) or not 0 < weight < 1e6:
            raise ValueError(f"expected a weight above 0, got {weight!r}")
        return replace(principal, streams=streams, weight=float(weight))
    except ValueError as error:
        raise TokenFileError(f"{path}, {digest[:20]}: {error}") from None
