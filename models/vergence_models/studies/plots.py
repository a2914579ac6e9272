"""Curves of the studies as PNGs, and one page of them all."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vergence_models.studies.tables import Table, with_times

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PAGE = "studies"  # file name of the page of all plots
SHADES = {"full": "C0", "fast": "C1", "lite": "C2"}


def drawable(tables: Sequence[Table]) -> dict[str, Table]:
    """Name of the plot -> its table; `runtime` is the main table against its times."""
    by_name = {table.name: table for table in tables}
    plots = {}
    if "main" in by_name and "times" in by_name:
        plots["runtime"] = with_times(by_name["main"], by_name["times"])
    plots |= {name: table for name, table in by_name.items() if table.curves}
    return plots


def draw(axes: Axes, name: str, table: Table) -> None:
    if name == "runtime":
        draw_runtime(axes, table)
        return
    from matplotlib import colormaps

    # More than ten curves need more than ten colours; of its pairs the strong ones come first.
    shades = [colormaps["tab20"](index) for index in (*range(0, 20, 2), *range(1, 20, 2))]
    axes.set_prop_cycle(color=shades)
    highest = max(max(curve.epe) for curve in table.curves)
    for curve in table.curves:
        marker = "." if len(curve.x) < 15 else ""
        style = "--" if curve.dashed else "-"
        axes.plot(curve.x, curve.epe, style, marker=marker, label=curve.label)
    axes.set(xlabel=table.x_label, ylabel="EPE [px]", title=table.title)
    if table.logarithmic:
        axes.set(xscale="log", yscale="log")
        for ticks in (axes.yaxis.set_major_formatter, axes.yaxis.set_minor_formatter):
            ticks("{x:g}")
        axes.grid(which="both", linewidth=0.3)
    else:
        axes.set_ylim(0, 1.1 * highest)
    axes.legend(fontsize=6, loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)


def draw_runtime(axes: Axes, table: Table) -> None:
    """Each method as a point: circles carry a state, squares do not; one colour for a network."""
    for row in table.rows:
        if "ms" not in row.values or "epe" not in row.values:
            continue
        shade = SHADES.get(row.label.split()[0].rstrip(","), "0.4")
        marker = "o" if "warm" in row.label else "s"
        axes.plot(row.values["ms"], row.values["epe"], marker, color=shade)
        # Close neighbours write one above and one below.
        above = sum(ord(letter) for letter in row.label) % 2 == 0
        axes.annotate(
            row.label.replace(" iterations", "").replace(" iteration", ""),
            (row.values["ms"], row.values["epe"]),
            xytext=(3, 4 if above else -9),
            textcoords="offset points",
            fontsize=6,
        )
    axes.set(xscale="log", xlabel="time of a 640x480 frame [ms]", ylabel="EPE [px]")
    axes.set(title="Runtime against error")
    axes.margins(x=0.4, y=0.2)
    axes.set_ylim(bottom=0)


def draw_plots(tables: Sequence[Table], folder: Path) -> list[str]:
    """One PNG per study that has curves, and a page of all; returns the names of the former."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    plots = drawable(tables)
    for name, table in plots.items():
        figure, axes = plt.subplots(figsize=(7, 4.5), layout="constrained")
        draw(axes, name, table)
        figure.savefig(folder / f"{name}.png", dpi=100)
        plt.close(figure)
    if plots:
        rows = (len(plots) + 1) // 2
        figure, grid = plt.subplots(
            rows, 2, figsize=(15, 3.9 * rows), layout="constrained", squeeze=False
        )
        for axes in grid.flat[len(plots) :]:
            axes.set_axis_off()
        for axes, (name, table) in zip(grid.flat, plots.items(), strict=False):
            draw(axes, name, table)
        figure.savefig(folder / f"{PAGE}.png", dpi=75)
        plt.close(figure)
    return list(plots)
