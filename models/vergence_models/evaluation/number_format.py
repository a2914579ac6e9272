"""Numbers for columns of a Markdown table: all of a column have the same decimals."""

from __future__ import annotations

from collections.abc import Iterable


def decimals(values: Iterable[float]) -> int:
    """The decimals of a column: none for whole numbers, one from 10 on, otherwise two."""
    known = list(values)
    if all(float(value).is_integer() for value in known):
        return 0
    return 1 if max(map(abs, known)) >= 10 else 2


def cell(value: float | None, places: int) -> str:
    """A number with so many decimals; an unknown one is an empty cell."""
    return "" if value is None else f"{value:.{places}f}"
