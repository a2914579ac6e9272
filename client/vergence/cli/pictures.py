"""Pictures of disparity: panels with captions and colour scales, as sheets and as video.

Input images are RGB, maps are in pixels. Pictures are BGR uint8 [H, W, 3], as OpenCV writes them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from vergence_proto.film import FilmWriter

Picture = NDArray[np.uint8]  # [H, W, 3], BGR
Map = NDArray[np.float32]  # [H, W], NaN = no value

_BACKGROUND = (29, 24, 21)
_NO_VALUE = (70, 64, 60)
_TEXT = (228, 224, 220)
_FAINT = (150, 144, 138)
_FONT = cv2.FONT_HERSHEY_DUPLEX
_MARGIN = 16
_BAR_HEIGHT = 50
_LARGEST_POINT_PX = 13


@dataclass(frozen=True, slots=True)
class Scale:
    """A colour map over [0, top] pixels; larger values take the last colour."""

    name: str
    top_px: float
    colormap: int

    def paint(self, values: Map) -> Picture:
        """Colour a map; pixels without a value are grey."""
        share = np.nan_to_num(values / self.top_px, nan=0.0, posinf=1.0, neginf=0.0)
        levels = (np.clip(share, 0, 1) * 255).astype(np.uint8)
        colours = np.asarray(cv2.applyColorMap(levels, self.colormap), np.uint8)
        colours[~np.isfinite(values)] = _NO_VALUE
        return colours

    def bar(self, width: int) -> Picture:
        """Draw the scale with its ticks, ``width`` pixels wide."""
        height, ramp_height = _BAR_HEIGHT, 12
        picture = _blank(height, width)
        ramp = np.linspace(0, self.top_px, width, dtype=np.float32)
        picture[:ramp_height] = self.paint(np.tile(ramp, (ramp_height, 1)))
        for share in (0.0, 0.25, 0.5, 0.75, 1.0):
            more = "+" if share == 1 else ""
            label = f"{self.top_px * share:g}{more}"
            text_width = _text_width(label, 0.4)
            x = round(share * (width - 1) - share * text_width)
            _write(picture, label, x, ramp_height + 16, 0.4, _FAINT)
        _write(picture, f"{self.name}, px", 0, height - 6, 0.4, _FAINT)
        return picture


def disparity_scale(disparity_px: Map) -> Scale:
    """Make a turbo scale up to the 98th percentile, rounded up to a multiple of 16 px."""
    known = disparity_px[np.isfinite(disparity_px)]
    top_px = float(np.percentile(known, 98)) if known.size else 64.0
    return Scale("disparity", max(16.0, 16.0 * np.ceil(top_px / 16)), cv2.COLORMAP_TURBO)


ERROR_SCALE = Scale("error against truth", 4.0, cv2.COLORMAP_INFERNO)


@dataclass(frozen=True, slots=True, eq=False)
class Row:
    """One frame of a sheet or a video: the image, its disparity, and the ground truth."""

    caption: str
    left: NDArray[np.uint8]  # [H, W, 3], RGB
    disparity_px: Map
    truth_px: Map | None = None

    def panels(self, scale: Scale) -> list[Picture]:
        """Draw the image, the disparity, and the error if there is ground truth."""
        view = np.asarray(cv2.cvtColor(self.left, cv2.COLOR_RGB2BGR), np.uint8)
        panels = [view, scale.paint(self.disparity_px)]
        if self.truth_px is not None:
            # A missing value counts as a disparity of zero.
            error_px = np.abs(np.nan_to_num(self.disparity_px, nan=0.0) - self.truth_px)
            panels.append(ERROR_SCALE.paint(_spread(error_px)))
        return panels


def _spread(error_px: Map) -> Map:
    """Enlarge the points of a sparse map to the gap between them, so that they are visible."""
    known = np.isfinite(error_px)
    gap_px = min(round(1 / np.sqrt(max(known.mean(), 1e-6))), _LARGEST_POINT_PX)
    point = np.ones((gap_px, gap_px), np.uint8)
    spread = cv2.dilate(np.where(known, error_px, np.float32(-1)), point)
    return np.where(spread < 0, np.float32(np.nan), spread)


def sheet(title: str, rows: Sequence[Row], *, panel_width: int = 480) -> Picture:
    """Draw all rows under each other, with a title above and the colour scales below."""
    scale = disparity_scale(rows[0].disparity_px if rows[0].truth_px is None else rows[0].truth_px)
    parts = [_heading(title, rows[0], panel_width)]
    parts += [_strip(row, scale, panel_width) for row in rows]
    parts.append(_scales(rows[0], scale, panel_width))
    return np.vstack([_blank(_MARGIN // 2, parts[0].shape[1]), *parts])


class Video:
    """An MP4 with one row per frame; use it inside ``with``.

    Raises CannotFilm: the file cannot be written, or PyAV is missing.
    """

    def __init__(self, path: Path, first: Row, *, title: str, fps: float) -> None:
        self._scale = disparity_scale(
            first.disparity_px if first.truth_px is None else first.truth_px
        )
        self._heading = _heading(title, first, 480)
        self._scales = _scales(first, self._scale, 480)
        self._film = FilmWriter(path, fps=fps)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._film.__exit__(kind, error, trace)

    def add(self, row: Row) -> None:
        """Append a frame."""
        picture = np.vstack([self._heading, _strip(row, self._scale, 480), self._scales])
        self._film.add(picture[..., ::-1])  # BGR to RGB


def _heading(title: str, row: Row, panel_width: int) -> Picture:
    names = ["left image", "disparity", "error"][: 2 if row.truth_px is None else 3]
    picture = _blank(72, _width(len(names), panel_width))
    _write(picture, title, _MARGIN, 30, 0.7, _TEXT)
    for column, name in enumerate(names):
        _write(picture, name, _column(column, panel_width), 62, 0.5, _FAINT)
    return picture


def _strip(row: Row, scale: Scale, panel_width: int) -> Picture:
    """Draw the panels of one row side by side, with its caption below."""
    panels = row.panels(scale)
    height = round(panel_width * row.left.shape[0] / row.left.shape[1])
    picture = _blank(height + 30, _width(len(panels), panel_width))
    for column, panel in enumerate(panels):
        x = _column(column, panel_width)
        small = cv2.resize(panel, (panel_width, height), interpolation=cv2.INTER_AREA)
        picture[:height, x : x + panel_width] = small
    _write(picture, row.caption, _MARGIN, height + 18, 0.45, _TEXT)
    return picture


def _scales(row: Row, scale: Scale, panel_width: int) -> Picture:
    scales = [None, scale] if row.truth_px is None else [None, scale, ERROR_SCALE]
    picture = _blank(_BAR_HEIGHT + _MARGIN, _width(len(scales), panel_width))
    for column, each in enumerate(scales):
        if each is not None:
            x = _column(column, panel_width)
            picture[:_BAR_HEIGHT, x : x + panel_width] = each.bar(panel_width)
    return picture


def _column(index: int, panel_width: int) -> int:
    return _MARGIN + index * (panel_width + _MARGIN)


def _width(columns: int, panel_width: int) -> int:
    return _column(columns, panel_width)


def _blank(height: int, width: int) -> Picture:
    return np.full((height, width, 3), _BACKGROUND, np.uint8)


def _text_width(text: str, size: float) -> int:
    (width, _), _ = cv2.getTextSize(text, _FONT, size, 1)
    return int(width)


def _write(
    picture: Picture, text: str, x: int, y: int, size: float, colour: tuple[int, int, int]
) -> None:
    cv2.putText(picture, text, (x, y), _FONT, size, colour, 1, cv2.LINE_AA)
