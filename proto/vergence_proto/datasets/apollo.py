"""ApolloScape stereo: ``apollo:ROOT/stereo_train_001``.

::

    camera_5 camera_6/171206_034625454_Camera_5.jpg ..._Camera_6.jpg    left and right, 3130x960
    disparity/171206_034625454_Camera_5.png       16 bits, disparity x256; 0 unknown
    fg_mask bg_mask/171206_034625454_Camera_5.png not 0 in either: where the benchmark judges
    intrinsic.txt                                 K = [f, 0, cx; 0, f, cy; 0, 0, 1]

For files of another scale, ``?steps=N`` states how many stored steps make a pixel. No baseline is
published with the files: a nominal one stands in, and lengths are not metres.
"""

import datetime
import re
from functools import partial
from pathlib import Path

import numpy as np

from vergence_proto.datasets.files import DatasetError, numbers, read_lines
from vergence_proto.datasets.listing import found, image_beside, images
from vergence_proto.datasets.packings import nominal_rig, read_mask, read_scaled, size_of
from vergence_proto.datasets.source import FrameFiles, StereoSource, Truth, rectified_rig
from vergence_proto.types import StereoRig

_STEPS_PER_PX = 256.0
_NOMINAL_BASELINE_M = 0.1
_IMAGE = r"\d{6}_\d{9}_Camera_5"


def find(root: Path) -> list[Path]:
    """List every recording in or under ``root``."""
    return [
        folder.parent for folder in found(root, "camera_5") if (folder.parent / "camera_6").is_dir()
    ]


def open_path(path: Path, *, steps: float = _STEPS_PER_PX) -> StereoSource:
    """Open one recording.

    Raises DatasetError: a file is missing or wrong.
    """
    lefts = images(path / "camera_5", _IMAGE)
    if not lefts:
        raise DatasetError(
            f"{path / 'camera_5'}: expected images 171206_034625454_Camera_5.jpg, found none"
        )
    if not steps > 0:
        raise DatasetError(f"{path}: expected positive steps per pixel, got {steps:g}")
    files = [
        FrameFiles(
            left,
            image_beside(left, path / "camera_6", left.stem.replace("Camera_5", "Camera_6")),
            _capture_ns(left),
            read_truth=partial(_truth, path, f"{left.stem}.png", steps)
            if (path / "disparity" / f"{left.stem}.png").is_file()
            else None,
        )
        for left in lefts
    ]
    rig = _read_rig(path, size_of(*lefts))
    return StereoSource(path.name, rig, None, files, metric=False)


def _read_rig(path: Path, size: tuple[int, int]) -> StereoRig:
    origin = next(
        (each for each in (path, path.parent) if (each / "intrinsic.txt").is_file()), None
    )
    if origin is None:
        return nominal_rig(path, size)
    text = " ".join(read_lines(origin / "intrinsic.txt", "K = [f, 0, cx; 0, f, cy; 0, 0, 1]"))
    matrix = re.search(r"K\s*=\s*\[([^\]]*)\]", text)
    if matrix is None:
        raise DatasetError(f"{origin / 'intrinsic.txt'}: expected K = [...], got {text[:60]!r}")
    words = matrix[1].replace(";", " ")
    fx, _, cx, _, fy, cy, *_ = numbers(words, 9, f"{origin / 'intrinsic.txt'}, K")
    return rectified_rig(
        origin / "intrinsic.txt",
        size,
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        baseline_m=_NOMINAL_BASELINE_M,
    )


def _capture_ns(path: Path) -> int:
    date, time, *_ = path.stem.split("_")
    try:
        whole = datetime.datetime.strptime(f"{date}{time[:6]}+0000", "%y%m%d%H%M%S%z")
    except ValueError as error:
        raise DatasetError(f"{path}: expected a time in the name: {error}") from None
    return int(whole.timestamp()) * 1_000_000_000 + int(time[6:]) * 1_000_000


def _truth(path: Path, name: str, steps: float) -> Truth:
    masks = [path / kind / name for kind in ("fg_mask", "bg_mask")]
    read = [read_mask(each) for each in masks if each.is_file()]
    offset_px = read_scaled(path / "disparity" / name, steps)
    return Truth(offset_px, np.logical_or.reduce(read) if read else None)
