"""Middlebury 2014 and 2021, and MiddEval3: ``middlebury:ROOT/Motorcycle-perfect``.

::

    im0.png im1.png
    calib.txt                     cam0=[f 0 cx; 0 f cy; 0 0 1], doffs, baseline (mm), width, height
    disp0.pfm or disp0GT.pfm      pixel offset u_left - u_right; +inf unknown
    mask0nocc.png                 MiddEval3: 255 visible in both, 128 occluded, 0 unknown

Z = f * baseline / (d + doffs), where doffs = cx1 - cx0.
"""

import re
from functools import partial
from pathlib import Path

import numpy as np

from vergence_proto.datasets.files import DatasetError, numbers, read_lines
from vergence_proto.datasets.images import read_pfm, read_stored
from vergence_proto.datasets.listing import found, image_beside
from vergence_proto.datasets.packings import offsets_of_either_sign
from vergence_proto.datasets.source import FrameFiles, StereoSource, Truth, rectified_rig
from vergence_proto.types import StereoRig

_MM_PER_M = 1000.0
_VISIBLE = 255


def find(root: Path) -> list[Path]:
    """List every scene of Middlebury in or under ``root``."""
    return [path for path in find_all(root) if not is_eth3d(path)]


def find_all(root: Path) -> list[Path]:
    """List every scene with this calibration in or under ``root``: Middlebury's and ETH3D's."""
    return [path.parent for path in found(root, "calib.txt") if _image(path.parent, 0).is_file()]


def is_eth3d(path: Path) -> bool:
    """Decide by its files and folders whether a scene with this calibration is ETH3D's."""
    parent = path.absolute().parent.name
    return (path / "cameras.txt").is_file() or parent.startswith("two_view")


def open_path(path: Path) -> StereoSource:
    """Open one scene. Raises DatasetError: a file is missing or wrong."""
    return open_scene(path, truth_folder=path)


def open_scene(path: Path, *, truth_folder: Path) -> StereoSource:
    """Open a scene whose truth is in another folder.

    Raises DatasetError: a file is missing or wrong.
    """
    names = (truth_folder / name for name in ("disp0.pfm", "disp0GT.pfm"))
    truth = next((each for each in names if each.exists()), None)
    pair = FrameFiles(
        _image(path, 0),
        _image(path, 1),
        capture_ns=0,
        read_truth=partial(_truth, truth, truth_folder / "mask0nocc.png") if truth else None,
    )
    return StereoSource(path.name, _rig(path / "calib.txt"), None, [pair])


def _image(path: Path, camera: int) -> Path:
    return image_beside(Path("any.png"), path, f"im{camera}")


def _rig(path: Path) -> StereoRig:
    pairs = (line.partition("=") for line in read_lines(path, "Middlebury's calibration"))
    values = {key.strip(): value for key, equals, value in pairs if equals}
    for key in ("cam0", "baseline", "width", "height"):
        if key not in values:
            raise DatasetError(f"{path}: expected a line {key}=..., found none")

    def number(key: str) -> float:
        return numbers(values[key], 1, f"{path}, {key}")[0]

    words = re.sub(r"[\[\];]", " ", values["cam0"])
    f, _, cx, _, fy, cy, *_ = numbers(words, 9, f"{path}, cam0")
    return rectified_rig(
        path,
        (int(number("width")), int(number("height"))),
        fx=f,
        fy=fy,
        cx=cx,
        cx_right=cx + (number("doffs") if "doffs" in values else 0.0),
        cy=cy,
        baseline_m=number("baseline") / _MM_PER_M,
    )


def _truth(path: Path, mask_path: Path) -> Truth:
    offset_px = offsets_of_either_sign(read_pfm(path))
    if not mask_path.exists():
        return Truth(offset_px)
    mask = read_stored(mask_path)
    if mask.ndim != 2:
        raise DatasetError(f"{mask_path}: expected a grey PNG, got {list(mask.shape)}")
    return Truth(offset_px, visible=np.asarray(mask == _VISIBLE))
