"""The progress bars of this package's commands, on the terminal; elsewhere they show nothing."""

from __future__ import annotations

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

# Few, because drawing takes time that is measured as that of the network.
_PER_SECOND = 2


def progress_bar(*, counted: bool = True) -> Progress:
    """Make a bar on stderr whose tasks carry a ``note``; it disappears at the end.

    Without ``counted`` it shows no numbers, because they count nothing that a reader knows.
    """
    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        *([MofNCompleteColumn()] if counted else []),
        TimeElapsedColumn(),
        TimeRemainingColumn(compact=True),
        TextColumn("[dim]{task.fields[note]}"),
        console=Console(stderr=True),
        refresh_per_second=_PER_SECOND,
        transient=True,
    )


def no_progress() -> Progress:
    """Make a bar that is never drawn."""
    return Progress(console=Console(quiet=True))


def silent(note: str) -> None:
    """Say nothing of a step of the work."""
