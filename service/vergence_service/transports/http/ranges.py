"""Parts of an answer (RFC 9110, section 14): a transfer that was cut continues where it ended."""

import http
import re
from collections.abc import Mapping
from dataclasses import dataclass

from fastapi import Request, Response
from starlette.exceptions import HTTPException

_RANGE = re.compile(r"bytes=(\d{0,18})-(\d{0,18})")


@dataclass(frozen=True, slots=True)
class Part:
    """The bytes from ``start`` to before ``stop`` of an answer of ``total`` bytes."""

    start: int
    stop: int
    total: int

    @property
    def status(self) -> int:
        """200 for the whole, 206 for less."""
        whole = (self.start, self.stop) == (0, self.total)
        return http.HTTPStatus.OK if whole else http.HTTPStatus.PARTIAL_CONTENT

    @property
    def headers(self) -> dict[str, str]:
        """The headers that state the part."""
        length = {"Content-Length": str(self.stop - self.start)}
        if self.status == http.HTTPStatus.OK:
            return length
        return {**length, "Content-Range": f"bytes {self.start}-{self.stop - 1}/{self.total}"}


def wants_part(request: Request, tag: str) -> bool:
    """Return whether a request asks for a part of the answer with this ETag.

    Several parts at once are not answered apart: the answer is then the whole.
    """
    return _range_of(request, tag) is not None


def part_for(request: Request, total: int, tag: str) -> Part:
    """Return the part that a request asks for, or the whole.

    Raises HTTPException 416: it is past the end.
    """
    asked = _range_of(request, tag)
    if asked is None:
        return Part(0, total, total)
    first, last = asked.groups()
    start = int(first) if first else max(total - int(last), 0)
    stop = min(int(last) + 1, total) if first and last else total
    if start >= stop:
        raise HTTPException(
            http.HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE,
            f"expected a range within the {total} bytes of the answer, got {asked[0]}",
            {"Content-Range": f"bytes */{total}"},
        )
    return Part(start, stop, total)


def _range_of(request: Request, tag: str) -> re.Match[str] | None:
    asked = _RANGE.fullmatch(request.headers.get("range", "").replace(" ", ""))
    if asked is None or asked[0] == "bytes=-" or request.headers.get("if-range", tag) != tag:
        return None
    return asked


def has_already(request: Request, tag: str) -> bool:
    """Return whether the client has the answer with this ETag."""
    return tag in request.headers.get("if-none-match", "")


def ranged(
    request: Request, content: bytes, tag: str, media_type: str, headers: Mapping[str, str]
) -> Response:
    """Answer with content that is in memory: all of it, a part, or 304."""
    stated = {"ETag": tag, "Accept-Ranges": "bytes", **headers}
    if has_already(request, tag):
        return Response(status_code=http.HTTPStatus.NOT_MODIFIED, headers=stated)
    part = part_for(request, len(content), tag)
    return Response(
        content[part.start : part.stop],
        part.status,
        {**stated, **part.headers},
        media_type=media_type,
    )
