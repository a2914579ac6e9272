"""Plots: every curve is named at its end, no two names overlap, the paper stands beside ours."""

from __future__ import annotations

import itertools
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

mpl.use("Agg")

from matplotlib import pyplot as plt
from matplotlib.text import Text

from vergence_models.evaluation.direct_labels import End, label_ends, spread
from vergence_models.studies import paper
from vergence_models.studies.plots import Label, draw, draw_paper, draw_plots, shown
from vergence_models.studies.tables import Curve, Table, TableRow

STUDIES = Path(__file__).parents[2] / "models" / "studies"
PLACES = st.lists(st.floats(-1000, 1000), max_size=12)


@given(PLACES, st.floats(0.5, 50))
def test_names_are_apart_and_in_the_order_of_their_curves(places: list[float], gap: float) -> None:
    moved = spread(places, gap)
    order = sorted(range(len(places)), key=lambda index: places[index])
    for lower, upper in itertools.pairwise(order):
        assert moved[upper] - moved[lower] >= gap - 1e-6


@given(PLACES, st.floats(0.5, 50))
def test_names_move_no_more_than_they_must(places: list[float], gap: float) -> None:
    moved = spread(places, gap)
    # As a whole they stay where they are, and who is far from all others does not move.
    assert sum(moved) == pytest.approx(sum(places), abs=1e-6)
    for index, place in enumerate(places):
        others = [*places[:index], *places[index + 1 :]]
        if all(abs(place - other) > len(places) * gap for other in others):
            assert moved[index] == pytest.approx(place)


def test_equal_ends_are_spread_around_their_place() -> None:
    assert spread([5.0, 5.0, 5.0], 2.0) == [3.0, 5.0, 7.0]


def table_of(name: str, labels: list[str], **given: object) -> Table:
    curves = [Curve(label, [1.0, 2.0, 3.0], [3.0, 2.0, 1.0]) for label in labels]
    return Table(name, f"On `{name}`", "", {}, [], [], curves=curves, x_label="frame", **given)  # type: ignore[arg-type]


def words_of(axes: object) -> list[str]:
    return [text.get_text() for text in axes.texts]  # type: ignore[attr-defined]


def test_each_curve_has_its_name_and_there_is_no_legend() -> None:
    _, axes = plt.subplots()
    draw(axes, "cold", table_of("cold", ["lite, warm, 1 iteration", "SGBM, half size"]))
    assert words_of(axes) == ["lite, warm", "SGBM half size"]
    assert axes.get_legend() is None
    plt.close()


def test_names_of_one_end_do_not_overlap() -> None:
    figure, axes = plt.subplots()
    axes.set(xlim=(0, 1), ylim=(0, 1))
    label_ends(axes, [End(name, 1.0, 0.5, "C0") for name in "abcd"])
    figure.canvas.draw()
    # Of the words alone, without the line that leads to them.
    boxes = [Text.get_window_extent(text) for text in axes.texts]
    for lower, upper in itertools.pairwise(sorted(boxes, key=lambda box: float(box.y0))):
        assert upper.y0 >= lower.y1
    plt.close(figure)


def test_of_many_curves_the_main_ones_are_drawn() -> None:
    labels = [
        *(f"lite, warm, {count} iteration{'s' * (count > 1)}" for count in (1, 2, 5)),
        *(f"lite, every frame cold, {count} iterations" for count in (7, 20)),
        *(f"lite (PyTorch), every frame cold, {count} iterations" for count in (7, 20)),
        *("SGBM, full size", "SGBM, half size", "lite, warm, 1 iteration, state not moved"),
    ]
    few = [Curve(label, [1.0], [1.0]) for label in labels[:5]]
    assert shown(few) == few
    many = shown([Curve(label, [1.0], [1.0]) for label in labels])
    assert [curve.label for curve in many] == [labels[0], labels[4], "SGBM, full size"]


def test_a_label_is_read_to_its_words() -> None:
    label = Label.read("lite, every frame cold, 8 iterations, the last ones at 2x")
    assert (label.tier, label.cold, label.iterations) == ("lite", True, 8)
    assert label.short == "lite, every frame cold"


@pytest.mark.parametrize("name", ["speed", "noise", "cold"])
def test_the_paper_is_drawn_over_the_range_of_ours(name: str) -> None:
    _, axes = plt.subplots()
    table = table_of(name, ["lite, warm, 1 iteration"])
    draw_paper(axes, name, table)
    for line in axes.lines:
        x = np.asarray(line.get_xdata())
        assert x.min() >= 1
        assert x.max() <= 3
    assert words_of(axes) == [curve.label for curve in paper.CURVES[name]]
    plt.close()


def test_the_papers_tables_and_curves_agree() -> None:
    main = {row.label: row.values["epe"] for row in paper.MAIN}
    ours, fast = paper.CURVES["speed"]
    assert (ours.epe[0], fast.epe[0]) == (main["Ours, 1 iteration"], main["Ours-Fast"])
    timed = {curve.label: curve for curve in paper.CURVES["runtime"]}["Ours, 1 to 5 iterations"]
    for index, label in ((0, "Ours, 1 iteration"), (1, "Ours, 2 iterations")):
        assert timed.epe[index] == pytest.approx(main[label], abs=0.005)
        fps = next(row.values["fps"] for row in paper.MAIN if row.label == label)
        assert 1e3 / timed.x[index] == pytest.approx(fps, rel=0.01)
    assert paper.CURVES["noise"][0].epe[0] == pytest.approx(main["Ours, 1 iteration"], abs=0.011)
    warp = {row.label: row.values for row in paper.WARP}["with warp"]
    assert warp["6x"] == pytest.approx(ours.epe[ours.x.index(6)], abs=0.002)
    assert len(paper.CURVES["cold"][0].x) == 30


def test_every_plot_becomes_a_file(tmp_path: Path) -> None:
    rows = [
        TableRow("lite, warm, 1 iteration", {"epe": 1.0}),
        TableRow("SGBM, full size", {"epe": 2.0}),
    ]
    columns = {"epe": "EPE", "ms": "ms"}
    times = [TableRow(row.label, {"ms": 20.0 + 20 * index}) for index, row in enumerate(rows)]
    tables = [
        Table("main", "Main", "", columns, rows, []),
        Table("times", "Times", "", {"ms": "ms"}, times, []),
        table_of("speed", ["lite, warm, 1 iteration"]),
        table_of("training", ["lite, warm"], logarithmic=True),
    ]
    assert set(draw_plots(tables, tmp_path)) == {"runtime", "speed", "training"}
    for name in ("runtime", "speed", "training", "studies"):
        picture = plt.imread(tmp_path / f"{name}.png")
        assert picture[..., :3].min() < 0.5
