"""Learning curves of the runs, from their own logs; every other table must be read with them."""

from __future__ import annotations

from collections.abc import Sequence

from vergence_models.studies.bench import Bench
from vergence_models.studies.tables import Curve, Table, TableRow
from vergence_models.training.runs import Validation

COLUMNS = {
    "cold_epe": "cold EPE",
    "warm_epe": "warm EPE",
    "cold_d1": "cold D1 %",
    "warm_d1": "warm D1 %",
}


def learning_curves(bench: Bench) -> Table:
    """Show the progress of each run, and if its error still falls."""
    runs = [studied for studied in bench.networks if studied.history]
    rows, curves = [], []
    for studied in runs:
        history = studied.history
        for point in reported_history(history):
            reported = {key: point.measured[key] for key in COLUMNS if key in point.measured}
            rows.append(TableRow(f"{studied.name}, {point.steps:,} steps", reported))
        for kind in ("cold", "warm"):
            steps = [float(point.steps) for point in history]
            epes = [point.measured[f"{kind}_epe"] for point in history]
            curves.append(Curve(f"{studied.name}, {kind}", steps, epes, dashed=kind == "cold"))
    return Table(
        name="training",
        title="How far the training has come",
        text="EPE in px and D1 on the clips each run was validated on while it was trained: *cold* "
        "on first frames (4 iterations), *warm* on the others (1 iteration). A curve that still "
        "falls has not been trained long enough; a figure of such a network says where it stands, "
        "not where it will end.",
        columns=COLUMNS,
        rows=rows,
        training=[studied.training.words for studied in runs],
        curves=curves,
        x_label="training steps",
        logarithmic=True,
    )


def reported_history(history: Sequence[Validation]) -> list[Validation]:
    """The first, the last, and those between that doubled the steps of the one before."""
    reported = list(history[:1])
    for point in history[1:-1]:
        if point.steps >= 2 * reported[-1].steps and 2 * point.steps <= history[-1].steps:
            reported.append(point)
    return reported + list(history[1:][-1:])
