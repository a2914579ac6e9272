"""Comparison of a table with the paper's findings, in words computed from its figures."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

from vergence_models.evaluation.metric_accumulator import MetricAccumulator
from vergence_models.studies.networks import StudiedNetwork
from vergence_models.studies.tables import TableRow

PAPER_SETTLED = 15  # frames, at 30 Hz
GENTLE = 1.05  # EPE at noise level 1 may be so many times that without noise


def verdict(holds: bool) -> str:
    return "holds" if holds else "**does not hold yet**"


def main_findings(
    networks: Sequence[StudiedNetwork], found: Mapping[str, MetricAccumulator]
) -> list[str]:
    """One warm iteration against the same network without memory, tier by tier."""
    lines = []
    epes = {label: accumulator.summary().get("epe") for label, accumulator in found.items()}
    for tier in dict.fromkeys(studied.tier for studied in networks):
        same = [studied for studied in networks if studied.tier == tier]
        warm = next((c.warm_methods()[0].label for c in same if c.warm[:1] == (1,)), None)
        warm_epe = None if warm is None else epes.get(warm)
        if warm_epe is None:
            continue
        for studied in same:
            counts = zip(studied.single_frame, studied.single_frame_methods(), strict=True)
            for count, method in counts:
                alone = epes.get(method.label)
                if alone is None:
                    continue
                line = (
                    f"`{tier}`: one warm iteration has {warm_epe / alone:.2f} times the EPE of the "
                    f"same network, every frame cold, with {count} iterations"
                )
                if studied.network.refines_at_2x(count):
                    lines.append(f"{line} (the last ones at 2x, which the paper does not have).")
                    continue
                limit = 1.05 if count >= 20 else 1.0  # relative to the paper's RAFT-Stereo
                holds = verdict(warm_epe <= limit * alone)
                lines.append(f"{line}; the paper's shape: at most {limit:.2f}: {holds}.")
    return lines


def loss_pct(values: Mapping[str, float]) -> float:
    """The increase of EPE at six times the speed, in percent."""
    return 100 * (values["6x"] / values["1x"] - 1)


def warp_findings(cells: Mapping[str, Mapping[str, float]]) -> list[str]:
    """The paper's shape: EPE at 6x grows by under 20 % with a warp, by over 60 % without."""
    lines = []
    for label, values in cells.items():
        lost = loss_pct(values)
        if label.endswith("state moved"):
            comparison = f"the paper's shape: under +20 %: {verdict(lost < 20)}"
        elif label.endswith("state not moved"):
            leans = "holds" if lost > 60 else "this network leans less on its past"
            comparison = f"the paper's shape: over +60 %: {leans}"
        else:
            continue
        lines.append(f"{label}: {lost:+.0f} % EPE at 6x; {comparison}.")
    return lines


def noise_findings(cells: Mapping[str, Mapping[str, float]]) -> list[str]:
    """A monotone and gentle curve."""
    lines = []
    for label, values in cells.items():
        epes = list(values.values())
        rising = all(b >= 0.995 * a for a, b in itertools.pairwise(epes))
        gentle = values.get("1", epes[0]) <= GENTLE * epes[0]
        lines.append(
            f"{label}: {100 * (values.get('1', epes[0]) / epes[0] - 1):+.1f} % EPE at level 1, "
            f"{100 * (epes[-1] / epes[0] - 1):+.0f} % at level {list(values)[-1]}; a gentle, "
            f"monotone curve: {verdict(rising and gentle)}."
        )
    return lines


def cold_start_findings(rows: Sequence[TableRow]) -> list[str]:
    return [
        f"{row.label}: settled by frame {row.values['settled']:g} (the paper's: by frame "
        f"{PAPER_SETTLED})."
        for row in rows
        if "settled" in row.values
    ]
