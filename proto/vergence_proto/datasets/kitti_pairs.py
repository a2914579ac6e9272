"""KITTI stereo 2012 and 2015: single pairs with LiDAR truth.

A source is named ``kitti2012:ROOT/training/000046`` or ``kitti2015:ROOT/training/000046``. The
number is part of the files' names; there is no folder of that name::

    2012  image_0 image_1/%06d_10.png   disp_occ disp_noc/%06d_10.png
          calib/%06d.txt                P0: P1:
    2015  image_2 image_3/%06d_10.png   disp_occ_0 disp_noc_0/%06d_10.png
          calib_cam_to_cam/%06d.txt     P_rect_02: P_rect_03:

In 2012 the grey images are read, because the truth belongs to the grey cameras. The testing half
of both has no truth.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from vergence_proto.datasets.images import read_disparity_png
from vergence_proto.datasets.kitti import read_projections, rig_from_projections
from vergence_proto.datasets.listing import found, image_beside, images
from vergence_proto.datasets.packings import size_of
from vergence_proto.datasets.source import FrameFiles, StereoSource, Truth


@dataclass(frozen=True, slots=True)
class _Edition:
    left: str
    right: str
    calib: str
    label: str
    cameras: tuple[int, int]
    truth: str
    visible_truth: str


_2012 = _Edition("image_0", "image_1", "calib", "P{}:", (0, 1), "disp_occ", "disp_noc")
_2015 = _Edition(
    "image_2",
    "image_3",
    "calib_cam_to_cam",
    "P_rect_0{}:",
    (2, 3),
    "disp_occ_0",
    "disp_noc_0",
)


def find_2012(root: Path) -> list[Path]:
    """List every pair in or under ``root``."""
    return _find(root, _2012)


def find_2015(root: Path) -> list[Path]:
    """List every pair in or under ``root``."""
    return _find(root, _2015)


def open_2012(path: Path) -> StereoSource:
    """Open one pair. Raises DatasetError: a file is missing or wrong."""
    return _open(path, _2012)


def open_2015(path: Path) -> StereoSource:
    """Open one pair. Raises DatasetError: a file is missing or wrong."""
    return _open(path, _2015)


def _find(root: Path, edition: _Edition) -> list[Path]:
    folders = found(root, edition.left)
    lefts = (image for folder in folders for image in images(folder, r".*_10"))
    return [left.parent.parent / left.stem.removesuffix("_10") for left in lefts]


def _open(path: Path, edition: _Edition) -> StereoSource:
    split, stem = path.parent, f"{path.name}_10"
    name = f"{stem}.png"
    calib = split / edition.calib / f"{path.name}.txt"
    left = image_beside(Path(name), split / edition.left, stem)
    projections = read_projections(calib, edition.label, edition.cameras)
    truth = split / edition.truth / name
    pair = FrameFiles(
        left,
        image_beside(left, split / edition.right, stem),
        capture_ns=0,
        read_truth=partial(_truth, truth, split / edition.visible_truth / name)
        if truth.exists()
        else None,
    )
    rig = rig_from_projections(calib, projections, size_of(left))
    return StereoSource(path.name, rig, None, [pair])


def _truth(path: Path, visible_path: Path) -> Truth:
    visible = None
    if visible_path.exists():
        visible = np.isfinite(read_disparity_png(visible_path))
    return Truth(read_disparity_png(path), visible=visible)
