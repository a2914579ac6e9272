"""What ``demo`` and ``run`` share: where frames come from, and how they are shown."""

import json
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager
from pathlib import Path

import cv2
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
)

from vergence.cli.errors import Trouble
from vergence.cli.local_server import local_server
from vergence.cli.pictures import Row, sheet
from vergence.cli.streaming import Answered
from vergence_proto.accuracy import Accuracy, accuracy
from vergence_proto.datasets import DatasetError, StereoSource, open_source
from vergence_proto.types import Origin

_SHEET_ROWS = 4


def source_at(text: str) -> StereoSource:
    """Open ``KIND:PATH``. Raises Trouble: it is not there, or not what it should be."""
    try:
        source = open_source(text)
    except DatasetError as error:
        raise Trouble(str(error), exit_code=2) from None
    if len(source) == 0:
        raise Trouble(f"{text}: no frames", exit_code=2)
    return source


@asynccontextmanager
async def server_for(server: str | None, console: Console) -> AsyncIterator[str]:
    """The server that was named, or else one of our own for the length of the block."""
    if server is not None:
        yield server
        return
    with console.status("starting a server") as status:
        async with local_server() as address:
            status.stop()
            yield address
            status.update("stopping the server")
            status.start()


def progress_bar(console: Console) -> Progress:
    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("[dim]{task.fields[note]}"),
        console=console,
        transient=True,
    )


def accuracy_of(answered: Answered) -> Accuracy | None:
    """None where no truth is known."""
    source = answered.source
    if source.truth_px is None:
        return None
    return accuracy(answered.result.offset_px, source.truth_px, source.truth_mask)


def row_of(answered: Answered) -> Row:
    """The frame as it appears in pictures."""
    parts = [f"frame {answered.index}"]
    found = accuracy_of(answered)
    if found is not None and found.n:
        parts += [f"EPE {found.epe_px:.2f} px", f"D1 {found.d1_pct:.1f} %"]
    parts.append(f"{1e3 * answered.latency_s:.0f} ms")
    result = answered.result
    if result.origin is not Origin.WARM:
        parts.append(f"{result.origin.value}, {result.iterations} iterations")
    return Row(
        caption="    ".join(parts),
        left=answered.source.frame.left,
        disparity_px=result.offset_px,
        truth_px=answered.source.truth_px,
    )


def title_of(source: StereoSource, model_name: str) -> str:
    camera = source.rig.left
    return f"Vergence {model_name}: {source.name}, {camera.width} x {camera.height}"


def shown_in_sheet(count: int) -> list[int]:
    """Which of ``count`` frames a sheet shows: the first, the last, and some between."""
    rows = min(_SHEET_ROWS, count)
    return sorted({round(row * (count - 1) / max(rows - 1, 1)) for row in range(rows)})


def write_sheet(path: Path, title: str, rows: Sequence[Row]) -> None:
    if not cv2.imwrite(str(path), sheet(title, rows)):
        raise Trouble(f"cannot write {path}")


def write_json(path: Path, values: Mapping[str, object]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(values, indent=2) + "\n", "utf-8")
