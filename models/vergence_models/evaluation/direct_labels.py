"""Names of curves at their ends, instead of a legend."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_POINTS = 8.0  # size of the type
_LINE_HEIGHT = 1.25
_GAP_POINTS = 9.0  # from the axes to the names, where a thin line leads from curve to name


def spread(places: Sequence[float], gap: float) -> list[float]:
    """Move places apart until neighbours are ``gap`` apart, each as little as possible.

    The order stays. Least squares: places that touch move as one block to the mean of their own.
    """
    order = sorted(range(len(places)), key=lambda index: places[index])
    # Without the gaps, neighbours must only not fall: blocks that do are pooled.
    blocks: list[list[float]] = []
    for rank, index in enumerate(order):
        block = [places[index] - rank * gap]
        while blocks and _mean(blocks[-1]) > _mean(block):
            block = [*blocks.pop(), *block]
        blocks.append(block)
    level = [_mean(block) for block in blocks for _ in block]
    moved = [0.0] * len(places)
    for rank, index in enumerate(order):
        moved[index] = level[rank] + rank * gap
    return moved


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


class End(NamedTuple):
    """The last point of a curve, in the units of its axes."""

    name: str
    x: float
    y: float
    color: str


def label_ends(axes: Axes, ends: Sequence[End]) -> None:
    """Write each name right of the axes, beside the end of its curve and in its colour.

    Call it when the limits of the axes are set; the figure must leave room on the right.
    """
    places = [axes.transData.transform((end.x, end.y)) for end in ends]
    pixels_per_point = axes.get_figure(root=True).dpi / 72  # type: ignore[union-attr]
    height_px = _POINTS * _LINE_HEIGHT * pixels_per_point
    heights = spread([float(y) for _, y in places], height_px)
    for end, (x_px, y_px), to_px in zip(ends, places, heights, strict=True):
        right = (axes.bbox.x1 - x_px) / pixels_per_point + _GAP_POINTS
        axes.annotate(
            end.name,
            (end.x, end.y),
            xytext=(right, (to_px - y_px) / pixels_per_point),
            textcoords="offset points",
            va="center",
            fontsize=_POINTS,
            color=end.color,
            annotation_clip=False,
            arrowprops={
                **{"arrowstyle": "-", "color": end.color, "linewidth": 0.5, "alpha": 0.6},
                **{"shrinkA": 0, "shrinkB": 2, "relpos": (0.0, 0.5)},
            },
        )
