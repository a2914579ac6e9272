"""Submissions that a client may repeat: the header Idempotency-Key.

Source: draft-ietf-httpapi-idempotency-key-header-07. A key lasts as long as its job. The body of a
repeated request is not needed if it has a Content-Digest (RFC 9530); otherwise it is received, and
its digest compared.
"""

import base64
import hashlib
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from fastapi import Request

from vergence_proto.errors import BadShape, KeyInUse, KeyReused
from vergence_service.access.principals import Principal
from vergence_service.jobs.job import Job
from vergence_service.transports.http.uploads import client_of

_KEY = re.compile(r'"?([\x21\x23-\x7e ]{1,255})"?')
_DIGEST = re.compile(r"sha-256=:([A-Za-z0-9+/]{43}=):")


@dataclass(frozen=True, slots=True)
class Submission:
    """What identifies a submission."""

    key: str  # with its owner; empty: the client sent none
    fingerprint: str  # of all but the body
    body_sha256: str | None  # as the client states it, in hex

    @classmethod
    def of(cls, request: Request, caller: Principal) -> "Submission":
        """Read the headers. Raises BadShape: they are malformed."""
        stated = request.headers.get("idempotency-key")
        found = _KEY.fullmatch(stated.strip()) if stated is not None else None
        if stated is not None and found is None:
            raise BadShape(
                "expected an Idempotency-Key of 1 to 255 printable ASCII characters, in quotes, "
                f"got {stated[:40]!r}"
            )
        query = sorted(request.query_params.multi_items())
        parts = (request.method, request.url.path, query, request.headers.get("content-length"))
        fingerprint = hashlib.sha256(repr(parts).encode()).hexdigest()
        # Callers without a credential share a name.
        owner = caller.name if caller.proven else f"{caller.name}@{client_of(request)}"
        key = f"{owner} {found[1]}" if found else ""
        return cls(key, fingerprint, _stated_digest(request))

    def check(self, job: Job, body_sha256: str | None) -> None:
        """Raise KeyReused unless ``job`` was submitted by this request."""
        same_body = body_sha256 is None or body_sha256 == job.upload_sha256
        if self.fingerprint != job.key_fingerprint or not same_body:
            raise KeyReused(
                f"the Idempotency-Key {_shown(self.key)} belongs to sequence {job.job_id}, which "
                "was submitted with another body or other options; use a new key"
            )


def check_digest(stated: str | None, found: str) -> None:
    """Raise BadShape if a body is not the one whose digest was stated."""
    if stated not in (None, found):
        raise BadShape(
            f"the body has the SHA-256 {found}, and its Content-Digest states {stated}; "
            "it was damaged on its way: send it again"
        )


class KeysInUse:
    """The keys of submissions that are being received."""

    def __init__(self) -> None:
        self._keys: set[str] = set()

    @contextmanager
    def taken(self, key: str) -> Iterator[None]:
        """Take a key for the block. Raises KeyInUse. An empty key is nobody's."""
        if not key:
            yield
            return
        if key in self._keys:
            raise KeyInUse(
                f"the first request with the Idempotency-Key {_shown(key)} is still being "
                "received; try again when it has ended",
                retry_after_s=1.0,
            )
        self._keys.add(key)
        try:
            yield
        finally:
            self._keys.discard(key)


def _shown(key: str) -> str:
    """Return a key as the client stated it."""
    return repr(key.partition(" ")[2])


def _stated_digest(request: Request) -> str | None:
    stated = request.headers.get("content-digest")
    if stated is None:
        return None
    found = _DIGEST.search(stated)
    if found is None:
        raise BadShape(f"expected a Content-Digest of sha-256, got {stated[:80]!r}")
    return base64.b64decode(found[1]).hex()
