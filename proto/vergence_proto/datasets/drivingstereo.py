"""DrivingStereo: ``drivingstereo:ROOT/train-left-image/2018-07-09-16-11-56``, one drive.

::

    train-left-image train-right-image/DRIVE/DRIVE_%Y-%m-%d-%H-%M-%S-%ms.jpg
    train-disparity-map/DRIVE/DRIVE_....png     16 bits; half size x256, full size x128; 0 unknown
    calib/half-image-calib/DRIVE.txt            P_rect_101: P_rect_103: (3x4), T_103: (metres)

Testing and weather images have no folder per drive: ``.../left-image-half-size/DRIVE`` names the
images that start with ``DRIVE_``. The baseline is the length of T_103: the projections of
half-size images still hold the baseline of twice the focal length. Without calibration the rig is
nominal.
"""

import datetime
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from vergence_proto.datasets.files import DatasetError
from vergence_proto.datasets.listing import found, image_beside, images, read_keyed
from vergence_proto.datasets.packings import nominal_rig, read_scaled, size_of
from vergence_proto.datasets.source import FrameFiles, StereoSource, Truth, rectified_rig
from vergence_proto.types import StereoRig

_LEFT = re.compile(r"left[-_]image")
_DRIVE = r"\d{4}-\d\d-\d\d-\d\d-\d\d-\d\d"
_IMAGE = rf"{_DRIVE}_{_DRIVE}-\d+"
_HALF_STEPS_PER_PX = 256.0
_FULL_STEPS_PER_PX = 128.0
_FULL_WIDTH = 1762
_CALIB_LEVELS = 5  # folders upwards in which to look for calib/


def find(root: Path) -> list[Path]:
    """List every drive in or under ``root``."""
    lefts = {
        path.parent
        for path in found(root, "*_*-*.*")
        if _LEFT.search(str(path.parent)) and re.fullmatch(_IMAGE, path.stem)
    }
    drives = {
        folder if re.fullmatch(_DRIVE, folder.name) else folder / image.stem.split("_")[0]
        for folder in lefts
        for image in images(folder, _IMAGE)
    }
    return sorted(drives)


def open_path(path: Path) -> StereoSource:
    """Open one drive.

    Raises DatasetError: a file is missing or wrong.
    """
    if not any(_LEFT.search(part) for part in path.parts):
        raise DatasetError(
            f"{path}: expected a drive under left-image-half-size or train-left-image"
        )
    folder = path if path.is_dir() else path.parent
    lefts = images(folder, rf"{re.escape(path.name)}_{_DRIVE}-\d+")
    if not lefts:
        raise DatasetError(f"{folder}: expected images {path.name}_<time>.jpg, found none")
    right, disparity = (_beside(folder, kind) for kind in ("right{0}image", "disparity{0}map"))
    size = size_of(*lefts)
    full = "full-size" in str(folder) or ("half-size" not in str(folder) and size[0] >= _FULL_WIDTH)
    rig, metric = _read_rig(path, "full-image-calib" if full else "half-image-calib", size)
    files = [
        FrameFiles(
            left,
            image_beside(left, right, left.stem),
            _capture_ns(left),
            read_truth=_reader(disparity / f"{left.stem}.png", full),
        )
        for left in lefts
    ]
    return StereoSource(path.name, rig, _fps(files), files, metric=metric)


def _beside(folder: Path, kind: str) -> Path:
    """The folder of another kind of data; every part of the path that says left-image changes."""
    return Path(*(_LEFT.sub(lambda hit: kind.format(hit[0][4]), part) for part in folder.parts))


def _capture_ns(path: Path) -> int:
    *date, milliseconds = path.stem.split("_")[1].split("-")
    try:
        time = datetime.datetime(*(int(part) for part in date), tzinfo=datetime.UTC)  # type: ignore[arg-type,misc]
    except ValueError as error:
        raise DatasetError(f"{path}: expected a time in the name: {error}") from None
    return int(time.timestamp()) * 1_000_000_000 + int(milliseconds) * 1_000_000


def _fps(files: list[FrameFiles]) -> float | None:
    steps_ns = np.diff([each.capture_ns for each in files])
    return 1e9 / float(np.median(steps_ns)) if len(steps_ns) and np.median(steps_ns) > 0 else None


def _read_rig(path: Path, calib: str, size: tuple[int, int]) -> tuple[StereoRig, bool]:
    name = f"{path.name}.txt"
    candidates = [
        above / folder / calib / name
        for above in path.parents[:_CALIB_LEVELS]
        for folder in ("", "calib", "train-calib", "test-calib")
    ]
    origin = next((each for each in candidates if each.is_file()), None)
    if origin is None:
        return nominal_rig(path, size), False
    read = read_keyed(origin, "DrivingStereo's cameras", P_rect_101=12, P_rect_103=12, T_103=3)
    for key in ("P_rect_101", "P_rect_103", "T_103"):
        if key not in read:
            raise DatasetError(f"{origin}: expected a line {key}: with numbers, found none")
    left, right = (np.reshape(read[key], (3, 4)) for key in ("P_rect_101", "P_rect_103"))
    rig = rectified_rig(
        origin,
        size,
        fx=left[0, 0],
        fy=left[1, 1],
        cx=left[0, 2],
        cx_right=right[0, 2],
        cy=left[1, 2],
        baseline_m=float(np.linalg.norm(read["T_103"])),
    )
    return rig, True


def _reader(path: Path, full: bool) -> Callable[[], Truth] | None:
    steps_per_px = _FULL_STEPS_PER_PX if full else _HALF_STEPS_PER_PX
    return partial(_truth, path, steps_per_px) if path.is_file() else None


def _truth(path: Path, steps_per_px: float) -> Truth:
    return Truth(read_scaled(path, steps_per_px))
