"""Pictures with their names below, for contact sheets."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]  # [H, W, 3]; the order of the colours does not matter

BACKGROUND = (26, 26, 26)
_INK = (224, 224, 224)
_NAME_HEIGHT, _MARGIN = 40, 8


def captioned(picture: Picture, words: str, *, width: int = 320) -> Picture:
    """Return the picture in one width, with a margin and its name below.

    The result has ``width`` + 16 columns.
    """
    height = round(picture.shape[0] * width / picture.shape[1])
    way = cv2.INTER_NEAREST if width > picture.shape[1] else cv2.INTER_AREA
    tile = np.full((height + _NAME_HEIGHT, width + 2 * _MARGIN, 3), BACKGROUND, np.uint8)
    tile[_MARGIN : _MARGIN + height, _MARGIN : _MARGIN + width] = cv2.resize(
        picture, (width, height), interpolation=way
    )
    place = (_MARGIN, height + _NAME_HEIGHT - 10)
    cv2.putText(tile, words, place, cv2.FONT_HERSHEY_DUPLEX, 0.45, _INK, 1, cv2.LINE_AA)
    return tile
