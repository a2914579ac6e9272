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
    except (yaml.YAMLError, json.JSONDecodeError, RecursionError) as error:
        raise BadCalibration(f"{path}: neither YAML nor JSON: {error}".replace("\n", " ")) from None
    return Fields.of(path, read)


def _first_document(text: str) -> Any:
    return next(iter(yaml.safe_load_all(text)), None)


def _file_storage(path: Path, text: str) -> Mapping[str, Any]:
    import cv2  # here: the only format that needs it

    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        names = storage.root().keys() if storage.isOpened() else ()
        return {name: _value(storage.getNode(name)) for name in names}
    except cv2.error as error:
        raise BadCalibration(f"{path}: damaged: {error.err}") from None


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
