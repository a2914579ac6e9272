"""What a user of a published graph writes without this project: images in, disparity out."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime
from numpy.typing import NDArray

from vergence_models.foreign.textures import Scene

Image = NDArray[np.uint8]
Plane = NDArray[Any]  # float32
Feeds = Callable[[Image, Image], Mapping[str, Plane]]

_MEAN = np.array([0.485, 0.456, 0.406], np.float32)
_STD = np.array([0.229, 0.224, 0.225], np.float32)


def _planes(image: Plane) -> Plane:
    return np.ascontiguousarray(image.transpose(2, 0, 1)[None])


def _two(left: str, right: str, scaled: Callable[[Image], Plane]) -> Feeds:
    return lambda a, b: {left: _planes(scaled(a)), right: _planes(scaled(b))}


def _bytes(image: Image) -> Plane:
    return image.astype(np.float32)


def _imagenet(image: Image) -> Plane:
    return (_bytes(image) / 255 - _MEAN) / _STD


def _grey(image: Image) -> Plane:
    return cv2.cvtColor(_bytes(image), cv2.COLOR_RGB2GRAY)[..., None]


def _halves(left: Image, right: Image) -> Mapping[str, Plane]:
    large = [_bytes(left), _bytes(right)]
    small = [cv2.resize(each, None, fx=0.5, fy=0.5) for each in large]
    names = ("init_left", "init_right", "next_left", "next_right")
    return {name: _planes(each) for name, each in zip(names, [*small, *large], strict=True)}


# By the names of the layouts: what the graph is fed, and how its output becomes disparity.
_FEEDS: dict[str, Feeds] = {
    "raft": _two("x1", "x2", _bytes),
    "raft of any size": _two("x1", "x2", _bytes),
    "acvnet": _two("input.1", "onnx_2", _imagenet),
    "openstereo": _two("left_img", "right_img", _imagenet),
    "ess": _two("input_left", "input_right", lambda image: (_bytes(image) - 127.5) / 127.5),
    "hitnet": lambda a, b: {"input": _planes(np.concatenate([a, b], axis=2) / np.float32(255))},
    "hitnet of both views": lambda a, b: {
        "input": _planes(np.concatenate([a, b], axis=2) / np.float32(255))
    },
    "hitnet of grey images": lambda a, b: {
        "input": _planes(np.concatenate([_grey(a), _grey(b)], axis=2) / np.float32(255))
    },
    "crestereo": _halves,
    "crestereo without halves": _two("left", "right", _bytes),
    "coex": _two("left", "right", _imagenet),
    "cgi-stereo": _two("left", "right", lambda image: _bytes(image) / 255),
    "liteanystereo": _two("left", "right", _bytes),
    "foundationstereo": _two("left_image", "right_image", _imagenet),
    "igev": _two("image1", "image2", _bytes),
    "sixteenths, channels last": lambda a, b: {
        "a": _bytes(a)[None] / 255,
        "b": _bytes(b)[None] / 255,
    },
}
_FROM_OUTPUT: dict[str, Callable[[Plane], Plane]] = {
    "raft": lambda found: -found,
    "raft of any size": lambda found: -found,
    "crestereo": lambda found: found[:, 0],
    "crestereo without halves": lambda found: found[:, 0],
    "sixteenths, channels last": lambda found: found / 16,
}


def disparity_by_hand(layout: str, path: Path, pair: Scene) -> Plane:
    """Disparity [H, W] in pixels of the graph in ``path``, run by onnxruntime alone."""
    session: Any = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    feeds = dict(_FEEDS[layout](pair.left, pair.right))
    found, *_ = session.run(None, feeds)
    if layout in _FROM_OUTPUT:
        found = _FROM_OUTPUT[layout](found)
    disparity: Plane = found
    return disparity.reshape(pair.truth_px.shape)
