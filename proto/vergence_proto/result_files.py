"""Files of results, encoded alike by ``vergence run`` and by the jobs of a server.

=========== ======================================= ========================= ===============
output      PNG (``png16``)                         PFM                       array in NPZ
=========== ======================================= ========================= ===============
disparity   16 bits, u_left - u_right in pixels x256 float32; +inf: no value  float32, NaN
depth       16 bits, metres x256                    float32; +inf: no value   float32, NaN
sigma       16 bits, pixels x256                    float32; +inf: no value   float32, NaN
confidence  8 bits                                  8-bit PNG                 uint8
=========== ======================================= ========================= ===============

In PNG, 0 means no value. Disparity and depth of 256 and more have none; sigma ends at 255.996.
"""

import io
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vergence_proto.datasets import encode_disparity_png, encode_pfm
from vergence_proto.jobs import Output, ResultFormat
from vergence_proto.opencv import cv2
from vergence_proto.types import Plane

_MM_PER_M = np.float32(1000)
_LARGEST_SIGMA_PX = np.float32(65535 / 256)


@dataclass(frozen=True, slots=True, eq=False)
class EncodedMap:
    """One file of the result of one frame."""

    output: Output | None
    """The map in the file; None: all maps of the frame."""
    suffix: str
    """The suffix of the file's name, with its dot."""
    content: bytes


def encode_maps(maps: Mapping[Output, NDArray[Any]], form: ResultFormat) -> Iterator[EncodedMap]:
    """Encode the maps of one frame, [H, W] each: float32 with NaN, confidence uint8.

    ``form`` is no film.
    """
    if form is ResultFormat.NPZ:
        yield EncodedMap(None, ".npz", _npz({str(name): map_ for name, map_ in maps.items()}))
        return
    for output, map_ in maps.items():
        if output is Output.CONFIDENCE:
            yield EncodedMap(output, ".png", encode_confidence_png(map_))
        elif form is ResultFormat.PFM:
            yield EncodedMap(output, ".pfm", encode_pfm(map_))
        elif output is Output.SIGMA:
            yield EncodedMap(output, ".png", encode_sigma_png(map_))
        else:
            yield EncodedMap(output, ".png", encode_disparity_png(map_))


def encode_confidence_png(confidence: NDArray[np.uint8]) -> bytes:
    """Encode uint8 [H, W] as a grey PNG."""
    _, file = cv2.imencode(".png", confidence)  # no size that a rig has fails
    return file.tobytes()


def encode_sigma_png(sigma_px: Plane) -> bytes:
    """Encode an expected error [H, W] in pixels as 16-bit PNG, x256; large ones saturate."""
    return encode_disparity_png(np.minimum(sigma_px, _LARGEST_SIGMA_PX))


def encode_depth_mm_png(depth_m: Plane) -> bytes:
    """Encode depth [H, W] in metres as 16-bit PNG in millimetres; 0 where there is no value.

    Depth of 65.5355 m and more has no value, as :func:`beyond_mm_png` finds it.
    """
    stored = np.rint(np.nan_to_num(depth_m) * _MM_PER_M)
    stored[beyond_mm_png(depth_m)] = 0
    _, file = cv2.imencode(".png", stored.astype(np.uint16))
    return file.tobytes()


def beyond_mm_png(depth_m: Plane) -> NDArray[np.bool_]:
    """Find the depths [H, W] that a 16-bit PNG of millimetres cannot hold."""
    return np.asarray(depth_m * _MM_PER_M >= 65535.5)


def _npz(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **arrays)
    return file.getvalue()
