"""``vergence calib``: read a calibration of any tool, and show what it says."""

import re
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from vergence.cli.errors import CliError
from vergence_proto.calibration import Calibration, load_calibration, write_rig
from vergence_proto.types import Distortion, Intrinsics


def calib(
    file: Path,
    right: Path | None,
    *,
    size: str | None,
    unit_m: float,
    out: Path | None,
    console: Console,
) -> None:
    """Print a calibration, and write it if asked to.

    Raises
    ------
    CliError
        ``size`` is not WIDTHxHEIGHT.
    BadCalibration
        The file cannot be read as a rig.
    """
    calibration = load_calibration(file, right, size=_size(size), unit_m=unit_m)
    table = Table(show_header=False, box=None)
    for name, value in _rows(calibration):
        table.add_row(name, value)
    console.print(table)
    if out is not None:
        write_rig(out, calibration.rig)
        console.print(f"written to {out}")


def _rows(calibration: Calibration) -> list[tuple[str, str]]:
    rig = calibration.rig
    baseline_m = float(np.linalg.norm(rig.left_from_right.translation_m))
    turn_deg = np.degrees(2 * np.arccos(np.clip(rig.left_from_right.orientation_xyzw[3], -1, 1)))
    rectified = rig.as_rectified() is not None
    rows = [
        ("format", calibration.format),
        ("images", f"{rig.left.width}x{rig.left.height}"),
        ("left", _lens(rig.left)),
        ("right", _lens(rig.right)),
        ("baseline", f"{baseline_m * 1000:.1f} mm"),
        ("right against left", f"turned by {turn_deg:.2f} degrees"),
        ("rectified", "yes" if rectified else "no: the server rectifies the images"),
    ]
    if calibration.camera_time_offset_s is not None:
        rows.append(("camera to IMU", f"{calibration.camera_time_offset_s * 1000:+.2f} ms"))
    return rows


def _lens(camera: Intrinsics) -> str:
    across, down = (
        np.degrees(2 * np.arctan(side / 2 / focal))
        for side, focal in ((camera.width, camera.fx), (camera.height, camera.fy))
    )
    # Of a fisheye, the pinhole formula says nothing of the field of view.
    view = (
        "fisheye"
        if camera.distortion is Distortion.KANNALA_BRANDT
        else f"{across:.0f}x{down:.0f} degrees, {camera.distortion.value}"
    )
    return f"fx {camera.fx:.1f}, cx {camera.cx:.1f}, cy {camera.cy:.1f}; {view}"


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    found = re.fullmatch(r"(\d+)x(\d+)", text.strip())
    if found is None:
        raise CliError(f"--size: expected WIDTHxHEIGHT, as 640x480; got {text!r}")
    return int(found[1]), int(found[2])
