"""Titles, captions and the choice of frames for the pictures of ``demo`` and ``run``."""

from collections.abc import Sequence
from pathlib import Path

import cv2

from vergence.cli.pictures import Row, sheet
from vergence.cli.streaming import AnsweredFrame
from vergence_proto.geometry import RectifiedRig
from vergence_proto.types import Origin, OutputFormat, StereoRig

WITH_SIGMA = OutputFormat(sigma=True)
"""What a server must return for pictures."""

_SHEET_ROWS = 4
_SHOWN_OF_A_CAMERA = (0, 30, 90, 270)


def row_of(answered: AnsweredFrame) -> Row:
    """Make the row of a frame, with its caption."""
    parts = [f"frame {answered.index}"]
    found = answered.accuracy()
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
        sigma_px=result.sigma_px,
    )


def title_of(name: str, rig: StereoRig, model_name: str) -> str:
    """Return the title of a picture or a table: model, source and image size."""
    return f"Vergence {model_name}: {name}, {rig.left.width} x {rig.left.height}"


def shown_in_sheet(count: int | None) -> list[int]:
    """Choose which of ``count`` frames a sheet shows: the first, the last, and some between.

    If the count is not known, they are seconds apart.
    """
    if count is None:
        return list(_SHOWN_OF_A_CAMERA)
    rows = min(_SHEET_ROWS, count)
    return sorted({round(row * (count - 1) / max(rows - 1, 1)) for row in range(rows)})


def write_sheet(path: Path, title: str, rows: Sequence[Row], rig: RectifiedRig | None) -> None:
    """Write a sheet of rows as a picture. Raises OSError: the file cannot be written."""
    _, file = cv2.imencode(".png", sheet(title, rows, rig=rig))
    path.write_bytes(file.tobytes())  # by OpenCV itself, names beyond ASCII fail on Windows
