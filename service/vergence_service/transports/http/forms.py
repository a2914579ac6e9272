"""Write multipart/form-data to files on disk, part by part, as it arrives."""

from dataclasses import dataclass
from io import BufferedWriter
from pathlib import Path

from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header

from vergence_proto.errors import BadSequence


@dataclass(frozen=True, slots=True)
class FormPart:
    """One part of a form, in a file."""

    name: str
    path: Path


class FormWriter:
    """Writes each part to a file in ``folder``. All methods raise BadSequence on a bad form."""

    def __init__(self, content_type: str, folder: Path, *, max_parts: int) -> None:
        boundary = parse_options_header(content_type)[1].get(b"boundary")
        if not boundary:
            raise BadSequence("expected a boundary in the content type of multipart/form-data")
        self.parts: list[FormPart] = []
        self._folder = folder
        self._max_parts = max_parts
        self._header_name = bytearray()
        self._header_value = bytearray()
        self._headers: dict[bytes, bytes] = {}
        self._file: BufferedWriter | None = None
        self._complete = False
        try:
            self._parser = MultipartParser(
                boundary,
                {
                    "on_header_field": self._on_header_field,
                    "on_header_value": self._on_header_value,
                    "on_header_end": self._on_header_end,
                    "on_headers_finished": self._on_headers_finished,
                    "on_part_data": self._on_part_data,
                    "on_part_end": self.close,
                    "on_end": self._on_end,
                },
            )
        except FormParserError as error:
            raise BadSequence(f"expected multipart/form-data: {error}") from None

    def write(self, data: bytes) -> None:
        """Parse the next bytes of the form."""
        try:
            self._parser.write(data)
        except FormParserError as error:
            raise BadSequence(f"expected multipart/form-data: {error}") from None

    def finish(self) -> list[FormPart]:
        """Return all parts, in order. Raises BadSequence if the form was cut off."""
        if not self._complete:
            raise BadSequence("the form is cut off: its last boundary is missing")
        return self.parts

    def close(self) -> None:
        """Close the file of the current part."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _on_header_field(self, data: bytes, start: int, end: int) -> None:
        self._header_name += data[start:end]

    def _on_header_value(self, data: bytes, start: int, end: int) -> None:
        self._header_value += data[start:end]

    def _on_header_end(self) -> None:
        self._headers[bytes(self._header_name).lower()] = bytes(self._header_value)
        self._header_name.clear()
        self._header_value.clear()

    def _on_headers_finished(self) -> None:
        if len(self.parts) == self._max_parts:
            raise BadSequence(f"expected at most {self._max_parts} parts in the form")
        options = parse_options_header(self._headers.pop(b"content-disposition", b""))[1]
        self._headers.clear()
        path = self._folder / f"{len(self.parts):06d}"  # never a name that the client chose
        self.parts.append(FormPart(options.get(b"name", b"").decode("utf-8", "replace"), path))
        self._file = path.open("wb")

    def _on_part_data(self, data: bytes, start: int, end: int) -> None:
        if self._file is not None:
            self._file.write(memoryview(data)[start:end])

    def _on_end(self) -> None:
        self._complete = True
