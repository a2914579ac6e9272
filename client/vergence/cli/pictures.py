"""Pictures of disparity: panels with captions and colour scales, as sheets and as video.

Input images are RGB, maps are in pixels. Pictures are BGR uint8 [H, W, 3], as OpenCV writes them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from vergence_proto.film import FilmWriter
from vergence_proto.geometry import RectifiedRig

Picture = NDArray[np.uint8]  # [H, W, 3], BGR
Map = NDArray[np.float32]  # [H, W], NaN = no value

_BACKGROUND = (29, 24, 21)
_NO_VALUE = (70, 64, 60)
_TEXT = (228, 224, 220)
_FAINT = (150, 144, 138)
_FONT = cv2.FONT_HERSHEY_DUPLEX
_MARGIN = 16
_BAR_HEIGHT = 66
_LARGEST_POINT_PX = 13


@dataclass(frozen=True, slots=True)
class Scale:
    """A colour map over [0, top] pixels; larger values take the last colour."""

    name: str
    top_px: float
    colormap: int
    depth_m: Callable[[float], float] | None = None
    """Depth of a disparity, for a second row of ticks; None: it is not known."""

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
            labels = [f"{self.top_px * share:g}{more}"]
            if self.depth_m is not None:
                labels.append(_metres(self.depth_m(self.top_px * share)))
            for row, label in enumerate(labels):
                x = round(share * (width - 1 - _text_width(label, 0.4)))
                _write(picture, label, x, ramp_height + 16 + 16 * row, 0.4, _FAINT)
        unit = "px" if self.depth_m is None else "px and m"
        y = height - 6 - (16 if self.depth_m is None else 0)
        _write(picture, f"{self.name}, {unit}", 0, y, 0.4, _FAINT)
        return picture


def _metres(depth_m: float) -> str:
    return f"{depth_m:.{1 if depth_m < 10 else 0}f} m" if np.isfinite(depth_m) else "far"


def disparity_scale(disparity_px: Map, rig: RectifiedRig | None = None) -> Scale:
    """Make a turbo scale up to the 98th percentile, rounded up to a multiple of 16 px.

    With the rig of the maps, the scale has ticks in metres too.
    """
    known = disparity_px[np.isfinite(disparity_px)]
    top_px = float(np.percentile(known, 98)) if known.size else 64.0
    return Scale(
        "disparity",
        max(16.0, 16.0 * np.ceil(top_px / 16)),
        cv2.COLORMAP_TURBO,
        None if rig is None else partial(_depth_of_offset, rig),
    )


def _depth_of_offset(rig: RectifiedRig, offset_px: float) -> float:
    disparity_px = offset_px - rig.offset_of_zero_disparity_px
    return rig.fx * rig.baseline_m / disparity_px if disparity_px > 0 else np.inf


# One scale for both, so that the eye can compare the error with its prediction.
ERROR_SCALE = Scale("error against truth", 4.0, cv2.COLORMAP_INFERNO)
SIGMA_SCALE = Scale("sigma: the error that the network expects", 4.0, cv2.COLORMAP_INFERNO)


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """One picture of a row, under its name; it may have a scale of colours."""

    name: str
    picture: Picture
    scale: Scale | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Row:
    """One frame of a sheet or a video: the image and the maps that are known."""

    caption: str
    left: NDArray[np.uint8]  # [H, W, 3], RGB
    disparity_px: Map
    truth_px: Map | None = None
    sigma_px: Map | None = None

    def panels(self, scale: Scale) -> list[Panel]:
        """Draw the image, the disparity, the error if there is ground truth, and sigma."""
        view = np.asarray(cv2.cvtColor(self.left, cv2.COLOR_RGB2BGR), np.uint8)
        panels = [
            Panel("left image", view),
            Panel("disparity", scale.paint(self.disparity_px), scale),
        ]
        if self.truth_px is not None:
            # A missing value counts as a disparity of zero.
            error_px = np.abs(np.nan_to_num(self.disparity_px, nan=0.0) - self.truth_px)
            panels.append(Panel("error", ERROR_SCALE.paint(_spread(error_px)), ERROR_SCALE))
        if self.sigma_px is not None:
            panels.append(Panel("sigma", SIGMA_SCALE.paint(self.sigma_px), SIGMA_SCALE))
        return panels

    def scale(self, rig: RectifiedRig | None) -> Scale:
        """Choose a scale for the disparity: that of the truth, if it is known."""
        return disparity_scale(self.disparity_px if self.truth_px is None else self.truth_px, rig)


def _spread(error_px: Map) -> Map:
    """Enlarge the points of a sparse map to the gap between them, so that they are visible."""
    known = np.isfinite(error_px)
    gap_px = min(round(1 / np.sqrt(max(known.mean(), 1e-6))), _LARGEST_POINT_PX)
    point = np.ones((gap_px, gap_px), np.uint8)
    spread = cv2.dilate(np.where(known, error_px, np.float32(-1)), point)
    return np.where(spread < 0, np.float32(np.nan), spread)


def sheet(
    title: str, rows: Sequence[Row], *, rig: RectifiedRig | None = None, panel_width: int = 440
) -> Picture:
    """Draw all rows under each other, with a title above and the colour scales below."""
    scale = rows[0].scale(rig)
    drawn = [row.panels(scale) for row in rows]
    parts = [_heading(title, drawn[0], panel_width)]
    parts += [
        _strip(row.caption, panels, panel_width) for row, panels in zip(rows, drawn, strict=True)
    ]
    parts.append(_scales(drawn[0], panel_width))
    return np.vstack([_blank(_MARGIN // 2, parts[0].shape[1]), *parts])


class Video:
    """An MP4 with one row per frame; use it inside ``with``.

    Raises CannotFilm: the file cannot be written, or PyAV is missing.
    """

    def __init__(
        self,
        path: Path,
        first: Row,
        *,
        title: str,
        fps: float,
        rig: RectifiedRig | None = None,
        panel_width: int = 440,
    ) -> None:
        self._scale = first.scale(rig)
        self._width = panel_width
        panels = first.panels(self._scale)
        self._heading = _heading(title, panels, panel_width)
        self._scales = _scales(panels, panel_width)
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
        strip = _strip(row.caption, row.panels(self._scale), self._width)
        picture = np.vstack([self._heading, strip, self._scales])
        self._film.add(picture[..., ::-1])  # BGR to RGB


def _heading(title: str, panels: Sequence[Panel], panel_width: int) -> Picture:
    picture = _blank(72, _column(len(panels), panel_width))
    _write(picture, title, _MARGIN, 30, 0.7, _TEXT)
    for column, panel in enumerate(panels):
        _write(picture, panel.name, _column(column, panel_width), 62, 0.5, _FAINT)
    return picture


def _strip(caption: str, panels: Sequence[Panel], panel_width: int) -> Picture:
    """Draw the panels of one row side by side, with its caption below."""
    rows, columns = panels[0].picture.shape[:2]
    height = round(panel_width * rows / columns)
    picture = _blank(height + 30, _column(len(panels), panel_width))
    for column, panel in enumerate(panels):
        x = _column(column, panel_width)
        small = cv2.resize(panel.picture, (panel_width, height), interpolation=cv2.INTER_AREA)
        picture[:height, x : x + panel_width] = small
    _write(picture, caption, _MARGIN, height + 18, 0.45, _TEXT)
    return picture


def _scales(panels: Sequence[Panel], panel_width: int) -> Picture:
    picture = _blank(_BAR_HEIGHT + _MARGIN, _column(len(panels), panel_width))
    for column, panel in enumerate(panels):
        if panel.scale is not None:
            x = _column(column, panel_width)
            picture[:_BAR_HEIGHT, x : x + panel_width] = panel.scale.bar(panel_width)
    return picture


def _column(index: int, panel_width: int) -> int:
    return _MARGIN + index * (panel_width + _MARGIN)


def _blank(height: int, width: int) -> Picture:
    return np.full((height, width, 3), _BACKGROUND, np.uint8)


def _text_width(text: str, size: float) -> int:
    (width, _), _ = cv2.getTextSize(text, _FONT, size, 1)
    return int(width)


def _write(
    picture: Picture, text: str, x: int, y: int, size: float, colour: tuple[int, int, int]
) -> None:
    cv2.putText(picture, text, (x, y), _FONT, size, colour, 1, cv2.LINE_AA)
