"""The plots of the studies: our curves beside the paper's, each named at its end."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vergence_models.evaluation.direct_labels import End, label_ends
from vergence_models.studies import paper
from vergence_models.studies.tables import Curve, Table, with_times

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PAGE = "studies"  # file name of the page of all plots that the paper has too
RUNTIME = "runtime"  # the main table against its times

_SHADES = {"full": "C0", "fast": "C1", "lite": "C2", "SGBM": "0.45"}
_OTHERS_SHADE = "C4"  # of networks of others
_PAPER_SHADES = ("0.1", "0.5", "C3")
# More curves than this are drawn for the main methods only; the table has them all.
_MOST_CURVES = 9
_ROW_IN, _PANEL_IN, _NAMES_IN = 2.6, 3.4, 1.6  # inches: height; width of axes and of their names
_LEFT_IN, _BELOW_IN, _ABOVE_IN = 0.65, 0.55, 0.5
_RATES_HZ = (90, 30)  # of headsets and cameras
_TICKS_PX = (0.2, 0.3, 0.5, 0.7, 1, 1.5, 2, 3, 4, 5, 7, 10)
_TICKS_MS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)


@dataclasses.dataclass(frozen=True, slots=True)
class Label:
    """What the label of a method says."""

    tier: str
    pytorch: bool
    cold: bool
    iterations: int | None
    note: str
    """What else it says, shortened."""

    @classmethod
    def read(cls, text: str) -> Label:
        tier = re.split(r"[ ,]", text)[0]
        count = re.search(r"(\d+) iteration", text)
        notes = {
            "state not moved": "not moved",
            "1 on the first frame": "started with 1",
            "full size": "",
            "half size": "half size",
        }
        found = [short for long, short in notes.items() if long in text and short]
        return cls(
            tier,
            "(PyTorch)" in text,
            "cold" in text,
            int(count[1]) if count else None,
            ", ".join(found),
        )

    @property
    def short(self) -> str:
        """A name for the end of a curve."""
        if self.tier == "SGBM":
            return " ".join(filter(None, [self.tier, self.note]))
        cold = "every frame cold" if self.tier in _SHADES else "cold"  # names of others are long
        kind = cold if self.cold else "warm"
        return f"{self.tier}, {self.note or kind}"

    @property
    def style(self) -> str:
        """Solid for a warm state, dashed without one, dotted for anything else."""
        return ":" if self.note else "--" if self.cold else "-"


def drawable(tables: Sequence[Table]) -> dict[str, Table]:
    """Name of the plot -> its table."""
    by_name = {table.name: table for table in tables}
    plots = {}
    if "main" in by_name and "times" in by_name:
        plots[RUNTIME] = with_times(by_name["main"], by_name["times"])
    plots |= {name: table for name, table in by_name.items() if table.curves}
    return plots


def shown(curves: Sequence[Curve]) -> list[Curve]:
    """Choose all curves; of many, each tier's warm one, its best cold one, and SGBM."""
    if len(curves) <= _MOST_CURVES:
        return list(curves)
    chosen: dict[tuple[str, bool], tuple[int, Curve]] = {}
    for curve in curves:
        label = Label.read(curve.label)
        count = label.iterations or 0
        if label.pytorch or label.note or (not label.cold and count > 1):
            continue
        key = label.tier, label.cold
        if key not in chosen or chosen[key][0] < count:
            chosen[key] = count, curve
    return [curve for _, curve in chosen.values()]


def draw(axes: Axes, name: str, table: Table) -> None:
    """Draw our own curves."""
    if name == RUNTIME:
        _draw_runtime(axes, table)
        return
    curves, ends = shown(table.curves), []
    for curve in curves:
        label = Label.read(curve.label)
        style = "--" if curve.dashed else label.style
        shade = _SHADES.get(label.tier, _OTHERS_SHADE)
        _plot(axes, curve, style, shade)
        words = f"{label.tier}, cold" if curve.dashed else label.short
        ends.append(End(words, curve.x[-1], curve.epe[-1], shade))
    _frame(axes, table, curves, ends)


def draw_paper(axes: Axes, name: str, table: Table) -> None:
    """Draw the paper's curves of the same study."""
    curves, ends = paper.CURVES[name], []
    if name != RUNTIME:  # their frames took other times
        low, high = min(table.curves[0].x), max(table.curves[0].x)
        curves = [_within(curve, low, high) for curve in curves]
    for curve, shade in zip(curves, _PAPER_SHADES, strict=False):
        _plot(axes, curve, "-", shade)
        ends.append(End(curve.label, curve.x[-1], curve.epe[-1], shade))
    if name == RUNTIME:
        _frame_runtime(axes, curves, ends)
    else:
        _frame(axes, table, curves, ends)


def _within(curve: Curve, low: float, high: float) -> Curve:
    """The part of a curve over the same variable as ours."""
    points = [(x, y) for x, y in zip(curve.x, curve.epe, strict=True) if low <= x <= high]
    return Curve(curve.label, [x for x, _ in points], [y for _, y in points])


def _plot(axes: Axes, curve: Curve, style: str, shade: str) -> None:
    axes.plot(curve.x, curve.epe, style, marker="." if len(curve.x) < 15 else "", color=shade)


def _frame(axes: Axes, table: Table, curves: Sequence[Curve], ends: Sequence[End]) -> None:
    axes.set(xlabel=table.x_label, ylabel="EPE [px]")
    if table.logarithmic:
        axes.set(xscale="log", yscale="log")
        low, high = axes.get_ylim()
        axes.set_yticks([each for each in _TICKS_PX if low < each < high])
        axes.set_yticks([], minor=True)
        axes.yaxis.set_major_formatter("{x:g}")
    else:
        if len(table.curves[0].x) < 10:
            axes.set_xticks(table.curves[0].x)
            axes.xaxis.set_major_formatter("{x:g}")
        axes.set_ylim(0, 1.1 * max(max(curve.epe) for curve in curves))
    label_ends(axes, ends)


def _draw_runtime(axes: Axes, table: Table) -> None:
    """Error against time: a line for each tier, warm or cold, with a point per iteration count."""
    series: dict[tuple[str, bool], list[tuple[float, float, str]]] = {}
    for row in table.rows:
        label = Label.read(row.label)
        if label.pytorch or not {"ms", "epe"} <= set(row.values):
            continue  # PyTorch takes longer for the same figures
        count = str(label.iterations) if label.iterations else label.note or "full size"
        point = row.values["ms"], row.values["epe"], count
        series.setdefault((label.tier, label.cold), []).append(point)
    curves, ends = [], []
    for (tier, cold), points in series.items():
        points.sort()
        curve = Curve(tier, [ms for ms, _, _ in points], [epe for _, epe, _ in points])
        curves.append(curve)
        shade, marker = _SHADES.get(tier, _OTHERS_SHADE), "s" if cold else "o"
        counted = tier != "SGBM"
        style = "none" if not counted else "--" if cold else "-"
        axes.plot(curve.x, curve.epe, marker, linestyle=style, markersize=4, color=shade)
        if counted:
            name = f"{tier}, {'every frame cold' if cold else 'warm'}"
            ends.append(End(name, curve.x[-1], curve.epe[-1], shade))
        for ms, epe, count in points:
            words = count if counted else f"{tier}, {count}"
            axes.annotate(
                words,
                (ms, epe),
                (0, 4) if counted else (0, -11),
                textcoords="offset points",
                ha="center",
                fontsize=7 if counted else 8,
                color="0.2" if counted else shade,
            )
    _frame_runtime(axes, curves, ends)


def _frame_runtime(axes: Axes, curves: Sequence[Curve], ends: Sequence[End]) -> None:
    """Scales, the frame times of common rates, and the names of the lines."""
    axes.set(xscale="log", xlabel="time of a 640x480 frame [ms]", ylabel="EPE [px]")
    for ticks in (axes.xaxis.set_major_formatter, axes.xaxis.set_minor_formatter):
        ticks("{x:g}")
    times = [ms for curve in curves for ms in curve.x]
    low, high = 0.4 * min(times), 1.4 * max(times)
    ticks_ms = [each for each in _TICKS_MS if low < each < high]
    axes.set_xticks(ticks_ms)
    axes.set_xticks([], minor=True)
    axes.set_xlim(low, high)
    axes.set_ylim(0, 1.15 * max(max(curve.epe) for curve in curves))
    for rate_hz in _RATES_HZ:
        if low < 1e3 / rate_hz < high:
            axes.axvline(1e3 / rate_hz, color="0.7", linewidth=0.8, linestyle=(0, (4, 4)))
            axes.annotate(
                f"{rate_hz} Hz",
                (1e3 / rate_hz, 0),
                (2, 3),
                xycoords=("data", "axes fraction"),
                textcoords="offset points",
                fontsize=7,
                color="0.4",
            )
    label_ends(axes, ends)


def draw_plots(tables: Sequence[Table], folder: Path) -> list[str]:
    """One PNG per study that has curves, and a page of those that the paper has too.

    Returns the names of the former.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    plots = drawable(tables)
    for name, table in plots.items():
        _save(folder / f"{name}.png", {name: table})
    beside = set(paper.CURVES) - {RUNTIME}
    if page := {name: table for name, table in plots.items() if name in beside}:
        _save(folder / f"{PAGE}.png", page)
    return list(plots)


def _save(path: Path, plots: dict[str, Table]) -> None:
    """Write a row for each plot: ours, and the paper's if it has one."""
    from matplotlib import pyplot as plt

    columns = 2 if any(name in paper.CURVES for name in plots) else 1
    width_in = columns * (_LEFT_IN + _PANEL_IN + _NAMES_IN)
    height_in = len(plots) * (_ROW_IN + _ABOVE_IN + _BELOW_IN)
    with plt.rc_context(
        {
            **{"axes.spines.top": False, "axes.spines.right": False, "axes.grid": True},
            **{"grid.linewidth": 0.4, "grid.color": "0.88", "font.size": 9},
            **{"axes.titlesize": 10, "axes.titlelocation": "left", "axes.titleweight": "bold"},
        }
    ):
        figure = plt.figure(figsize=(width_in, height_in), dpi=100)
        for row, (name, table) in enumerate(plots.items()):
            title = "Time of a frame against its error" if name == RUNTIME else table.title
            axes = _axes_at(figure, row, 0)
            axes.set_title(title.replace("`", ""))
            draw(axes, name, table)
            if name in paper.CURVES:
                axes = _axes_at(figure, row, 1)
                axes.set_title("the paper's, on its data and machine", color="0.35")
                draw_paper(axes, name, table)
        figure.savefig(path)
        plt.close(figure)


def _axes_at(figure: Figure, row: int, column: int) -> Axes:
    """Add axes at a place of the grid, with room for the names right of them."""
    width_in, height_in = figure.get_size_inches()
    left = column * (_LEFT_IN + _PANEL_IN + _NAMES_IN) + _LEFT_IN
    bottom = height_in - (row + 1) * (_ROW_IN + _ABOVE_IN + _BELOW_IN) + _BELOW_IN
    return figure.add_axes(
        (left / width_in, bottom / height_in, _PANEL_IN / width_in, _ROW_IN / height_in)
    )
