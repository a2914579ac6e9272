"""The result of a study: a table, its curves and its findings, as JSON and Markdown."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vergence_models.evaluation.number_format import cell, decimals

FORMAT = 1

EPE_COLUMNS = {"epe": "EPE", "d1": "D1 %", "d3": "D3 %", "d5": "D5 %"}
TIME_COLUMNS = {"ms": "ms", "fps": "FPS", "cpu_ms": "CPU ms"}  # joined from the table of times


class StudyFileError(ValueError):
    """The JSON file holds no studies."""


@dataclass(frozen=True, slots=True)
class TableRow:
    label: str
    values: dict[str, float]  # column key -> value; unknown values are missing


@dataclass(frozen=True, slots=True)
class Curve:
    """EPE in px over the variable of the study. A dashed curve belongs to a solid one."""

    label: str
    x: list[float]
    epe: list[float]
    dashed: bool = False


@dataclass(frozen=True, slots=True)
class Table:
    """One study. Every table carries the training state of the networks in it."""

    name: str
    title: str
    text: str  # the experiment and its data
    columns: dict[str, str]  # key -> heading
    rows: list[TableRow]
    training: list[str]
    findings: list[str] = field(default_factory=list)
    paper: list[TableRow] = field(default_factory=list)  # the paper's figures, on its data
    paper_note: str = ""
    curves: list[Curve] = field(default_factory=list)
    x_label: str = ""
    logarithmic: bool = False  # both axes of the curves

    @property
    def labels(self) -> list[str]:
        return [row.label for row in self.rows]


def table_from_dict(values: dict[str, Any]) -> Table:
    """The inverse of ``dataclasses.asdict``; ``values`` is any JSON."""
    lists = {
        "rows": [TableRow(**row) for row in values["rows"]],
        "paper": [TableRow(**row) for row in values["paper"]],
        "curves": [Curve(**curve) for curve in values["curves"]],
    }
    return Table(**{**values, **lists})


def read_tables(path: Path) -> dict[str, Table]:
    """The tables of an earlier run; none if there is no such file. Raises StudyFileError."""
    if not path.exists():
        return {}
    try:
        contents = json.loads(path.read_text("utf-8"))
        if contents["format"] != FORMAT:
            raise StudyFileError(f"{path}: expected format {FORMAT}, got {contents['format']}")
        return {name: table_from_dict(values) for name, values in contents["studies"].items()}
    except (ValueError, KeyError, TypeError) as error:
        if isinstance(error, StudyFileError):
            raise
        raise StudyFileError(f"{path}: expected the JSON of studies: {error!r}") from None


def write_tables(path: Path, tables: Iterable[Table]) -> None:
    studies = {table.name: dataclasses.asdict(table) for table in tables}
    path.write_text(json.dumps({"format": FORMAT, "studies": studies}, indent=1) + "\n", "utf-8")


def with_times(table: Table, times: Table | None) -> Table:
    """The same table, its columns of time filled in from the table of times."""
    if times is None or not set(TIME_COLUMNS) & set(table.columns):
        return table
    known = {row.label: row.values for row in times.rows}
    rows = [
        TableRow(
            row.label,
            row.values | {k: v for k, v in known.get(row.label, {}).items() if k in TIME_COLUMNS},
        )
        for row in table.rows
    ]
    return dataclasses.replace(table, rows=rows)


def markdown(tables: Sequence[Table], missing: Sequence[str], plots: Iterable[str]) -> str:
    """The report. ``missing`` tiers are named; ``plots`` are the names of those drawn."""
    times = next((table for table in tables if table.name == "times"), None)
    drawn = set(plots)
    parts = ["# Studies"]
    if missing:
        names = ", ".join(f"`{name}`" for name in missing)
        parts.append(f"Without weights, and so left out of every table: {names}.")
    for table in tables:
        parts.append(_section(with_times(table, times)))
        picture = "runtime" if table is times else table.name
        if picture in drawn:
            parts.append(f"![{table.title}]({picture}.png)")
    return "\n\n".join(parts) + "\n"


def _section(table: Table) -> str:
    known = set[str]().union(*(row.values for row in table.rows))
    columns = [key for key in table.columns if key in known]
    headings = " | ".join(table.columns[key] for key in columns)
    lines = [f"## {table.title}", "", table.text, "", f"| | {headings} |"]
    lines.append("|---|" + "---:|" * len(columns))
    rows = [*table.rows, *table.paper]
    places = {
        key: decimals(row.values[key] for row in rows if key in row.values) for key in columns
    }
    lines += [_line(row.label, row, places) for row in table.rows]
    lines += [_line(f"*theirs, on their data:* {row.label}", row, places) for row in table.paper]
    if table.findings:
        lines += ["", *(f"- {finding}" for finding in table.findings)]
    if table.training:
        lines += ["", "Trained so far: " + "; ".join(table.training) + "."]
    if table.paper_note:
        lines += ["", table.paper_note]
    return "\n".join(lines)


def _line(label: str, row: TableRow, places: Mapping[str, int]) -> str:
    cells = [cell(row.values.get(key), count) for key, count in places.items()]
    return f"| {label} | " + " | ".join(cells) + " |"
