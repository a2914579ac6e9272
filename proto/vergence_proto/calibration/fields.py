"""The named values of a calibration file: YAML, JSON, or what OpenCV's FileStorage writes."""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from vergence_proto.calibration.parts import Fields
from vergence_proto.errors import BadCalibration
from vergence_proto.text import decoded_text

_LARGEST_BYTES = 1 << 20
_MOST_VALUES = 1 << 18


class _WithoutMerging(yaml.SafeLoader):
    """YAML without merge keys (``<<``): a few lines of them can stand for terabytes."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        for key, _ in node.value:
            if key.tag == "tag:yaml.org,2002:merge":
                raise yaml.constructor.ConstructorError(
                    None, None, "expected names and values, got a merge key <<", key.start_mark
                )


def read_fields(path: Path, *, opencv: bool = True) -> Fields:
    """Read the named values of a file; ``opencv``: also those of OpenCV's FileStorage.

    OpenCV's parser is not made for files of strangers: it allocates what a matrix says to have.

    Raises BadCalibration: there is no such file, or it holds none.
    """
    if not path.is_file():
        raise BadCalibration(f"{path}: not found; expected a calibration")
    if (size := path.stat().st_size) > _LARGEST_BYTES:
        raise BadCalibration(f"{path}: expected a calibration, got {size} bytes")
    text = decoded_text(path.read_bytes())
    if text is None:
        raise BadCalibration(f"{path}: expected text, a calibration")
    if re.match(r"%YAML:|<\?xml|<opencv_storage", text) or "opencv-matrix" in text:
        if not opencv:
            raise BadCalibration(f"{path}: expected YAML or JSON, got a file of OpenCV's")
        return Fields.of(path, _file_storage(path, text))
    try:
        # Of several documents, as a printed message has them, the first.
        read = (
            json.loads(text)
            if text.lstrip().startswith("{")
            else _first_document(text.expandtabs())
        )
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise BadCalibration(f"{path}: neither YAML nor JSON: {error}".replace("\n", " ")) from None
    if _is_endless(read):
        raise BadCalibration(f"{path}: expected a calibration, got more than {_MOST_VALUES} values")
    return Fields.of(path, read)


def _first_document(text: str) -> Any:
    return next(iter(yaml.load_all(text, _WithoutMerging)), None)


def _is_endless(read: Any) -> bool:
    """Count the values; those that YAML's references repeat count each time."""
    waiting, seen = [read], 0
    while waiting:
        value = waiting.pop()
        seen += 1
        parts = list(value.values()) if isinstance(value, dict) else value
        if isinstance(parts, list):
            waiting += parts
        if seen + len(waiting) > _MOST_VALUES:
            return True
    return False


def _file_storage(path: Path, text: str) -> Mapping[str, Any]:
    import cv2  # here: the only format that needs it

    if "<!DOCTYPE" in text:  # entities can grow without an end
        raise BadCalibration(f"{path}: expected OpenCV's XML, got a document type")
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        names = storage.root().keys() if storage.isOpened() else ()
        return {name: _value(storage.getNode(name)) for name in names}
    except cv2.error as error:
        raise BadCalibration(f"{path}: damaged: {error.err}") from None
    except SystemError:  # it failed while it reported an error
        raise BadCalibration(f"{path}: damaged: OpenCV cannot read it") from None


def _value(node: Any) -> Any:
    if node.isReal() or node.isInt():
        return node.real()
    if node.isString():
        return node.string()
    if node.isSeq():
        return [_value(node.at(index)) for index in range(node.size())]
    if node.isMap():
        matrix = node.mat()
        return None if matrix is None else matrix.tolist()
    return None
