"""Reading ONNX files without the onnx package: nodes, attributes and constants of a graph.

ONNX is protocol buffers; the field numbers are those of onnx.proto. A server has no onnx package,
and onnxruntime does not show the constants of a graph.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.generic]

_LARGEST_BYTES = 64 << 20  # the graphs of `lite` have 2 MB at most
_NUMBERED = ((1, "f4"), (2, "u1"), (3, "i1"), (6, "i4"), (7, "i8"), (9, "?"), (11, "f8"))
_DTYPES: Mapping[int, np.dtype[np.generic]] = {
    number: np.dtype(name).newbyteorder("<") for number, name in _NUMBERED
}
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5


class UnsupportedWeights(ValueError):
    """The files are damaged, or describe another network than this package computes."""


@dataclass(frozen=True, slots=True, eq=False)
class Node:
    """One operator of a graph."""

    op_type: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    attributes: Mapping[str, object]  # int, float, bytes, or a tuple of these


@dataclass(frozen=True, slots=True, eq=False)
class Graph:
    """The nodes of one or more files, in their order, and their constants by name."""

    nodes: list[Node] = field(default_factory=list)
    constants: dict[str, Array] = field(default_factory=dict)

    def add_file(self, path: Path) -> None:
        """Append the graph of a file. Raises UnsupportedWeights if it cannot be read."""
        try:
            if path.stat().st_size > _LARGEST_BYTES:
                raise UnsupportedWeights(f"{path} is larger than {_LARGEST_BYTES} bytes")
            self.add_bytes(path.read_bytes())
        except (OSError, UnsupportedWeights) as error:
            raise UnsupportedWeights(f"cannot read {path}: {error}") from None

    def add_bytes(self, data: bytes) -> None:
        """Append the graph of a serialised ModelProto. Raises UnsupportedWeights."""
        try:
            for number, value in _fields(memoryview(data)):
                if number == 7:
                    self._add_graph(_bytes(value))
        except (struct.error, IndexError, ValueError, OverflowError, MemoryError) as error:
            raise UnsupportedWeights(f"not an ONNX graph: {error}") from None

    def _add_graph(self, data: memoryview) -> None:
        for number, value in _fields(data):
            if number == 1:
                self.nodes.append(_node(_bytes(value)))
            elif number == 5:
                name, tensor = _tensor(_bytes(value))
                if tensor is not None:
                    self.constants[name] = tensor


def _fields(data: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """The fields of a message: number, and an integer or the bytes."""
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        kind = key & 7
        if kind == _VARINT:
            value, at = _varint(data, at)
            yield key >> 3, value
            continue
        if kind == _BYTES:
            length, at = _varint(data, at)
        elif kind in (_FIXED32, _FIXED64):
            length = 4 if kind == _FIXED32 else 8
        else:
            raise ValueError(f"unknown wire type {kind}")
        if length > len(data) - at:
            raise ValueError("a field is cut off")
        yield key >> 3, data[at : at + length]
        at += length


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value & (1 << 64) - 1, at
    raise ValueError("an integer has more than ten bytes")


def _bytes(value: int | memoryview) -> memoryview:
    if isinstance(value, int):
        raise ValueError("expected bytes, got an integer")
    return value


def _text(value: int | memoryview) -> str:
    return bytes(_bytes(value)).decode("utf-8")


def _signed(value: int | memoryview) -> int:
    if not isinstance(value, int):
        raise ValueError("expected an integer, got bytes")
    return value - (1 << 64) if value >> 63 else value


def _integers(value: int | memoryview) -> list[int]:
    """A repeated integer field: one value, or several packed."""
    if isinstance(value, int):
        return [_signed(value)]
    values, at = [], 0
    while at < len(value):
        one, at = _varint(value, at)
        values.append(_signed(one))
    return values


def _node(data: memoryview) -> Node:
    inputs: list[str] = []
    outputs: list[str] = []
    op_type = ""
    attributes: dict[str, object] = {}
    for number, value in _fields(data):
        if number == 1:
            inputs.append(_text(value))
        elif number == 2:
            outputs.append(_text(value))
        elif number == 4:
            op_type = _text(value)
        elif number == 5:
            name, content = _attribute(_bytes(value))
            attributes[name] = content
    return Node(op_type, tuple(inputs), tuple(outputs), attributes)


def _attribute(data: memoryview) -> tuple[str, object]:
    name, content = "", None
    several: list[object] = []
    for number, value in _fields(data):
        if number == 1:
            name = _text(value)
        elif number == 2:
            content = struct.unpack("<f", _bytes(value))[0]
        elif number == 3:
            content = _signed(value)
        elif number == 4:
            content = bytes(_bytes(value))
        elif number == 7:
            packed = _bytes(value)
            several += struct.unpack(f"<{len(packed) // 4}f", packed)
        elif number == 8:
            several += _integers(value)
    return name, tuple(several) if several else content


def _tensor(data: memoryview) -> tuple[str, Array | None]:
    """A constant, or None if its type is of no use here."""
    dims: list[int] = []
    kind, name = 0, ""
    raw: memoryview | None = None
    listed: list[float] = []
    for number, value in _fields(data):
        if number == 1:
            dims += _integers(value)
        elif number == 2:
            kind = _signed(value)
        elif number == 4:
            packed = _bytes(value)
            listed += struct.unpack(f"<{len(packed) // 4}f", packed)
        elif number in (5, 7):
            listed += _integers(value)
        elif number == 8:
            name = _text(value)
        elif number == 9:
            raw = _bytes(value)
    if kind not in _DTYPES:
        return name, None
    if any(size < 0 for size in dims):
        raise ValueError(f"{name!r} has a negative size")
    if raw is None:
        return name, np.array(listed, _DTYPES[kind]).reshape(dims)
    # A copy, for a file aligns nothing.
    return name, np.frombuffer(raw, _DTYPES[kind]).reshape(dims).copy()
