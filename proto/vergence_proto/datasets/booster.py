"""Booster: ``booster:ROOT/train/balanced/Bathroom``, one pair of each illumination.

::

    camera_00/im0.png ...     left, one image of each illumination; camera_02 is the right camera
    disp_00.npy               pixel offset of the left image, float32 [H, W]; 0 unknown
    mask_00.png               0: the right camera does not see it
    calib_00-02.xml           OpenCV: proj_matL and proj_matR [3, 4], baselineLR (mm)

The test half has no truth. The illuminations of a scene are read as one source, one per frame.
"""

import xml.etree.ElementTree as ElementTree
from functools import partial
from pathlib import Path

import numpy as np

from vergence_proto.datasets.files import DatasetError, existing, numbers
from vergence_proto.datasets.listing import found, image_beside, images
from vergence_proto.datasets.packings import (
    known_offsets,
    nominal_rig,
    read_mask,
    read_npy,
    size_of,
)
from vergence_proto.datasets.source import (
    FrameFiles,
    StereoSource,
    Truth,
    nominal_ns,
    rectified_rig,
)
from vergence_proto.geometry import Matrix
from vergence_proto.types import StereoRig

_MM_PER_M = 1000.0


def find(root: Path) -> list[Path]:
    """List every scene in or under ``root``."""
    return [
        folder.parent
        for folder in found(root, "camera_00")
        if (folder.parent / "camera_02").is_dir()
    ]


def open_path(path: Path) -> StereoSource:
    """Open one scene.

    Raises DatasetError: a file is missing or wrong.
    """
    lefts = images(path / "camera_00")
    if not lefts:
        raise DatasetError(f"{path / 'camera_00'}: expected images im0.png, im1.png, found none")
    rig, metric = _read_rig(path / "calib_00-02.xml", size_of(*lefts))
    truth = path / "disp_00.npy"
    files = [
        FrameFiles(
            left,
            image_beside(left, path / "camera_02", left.stem),
            nominal_ns(index, None),
            read_truth=partial(_truth, truth, path / "mask_00.png") if truth.exists() else None,
        )
        for index, left in enumerate(lefts)
    ]
    return StereoSource(path.name, rig, None, files, metric=metric)


def _read_rig(path: Path, size: tuple[int, int]) -> tuple[StereoRig, bool]:
    if not path.exists():
        return nominal_rig(path, size), False
    try:
        data = existing(path, "Booster's calibration").read_bytes()
        if b"<!DOCTYPE" in data:  # it may define entities that expand without end
            raise DatasetError(f"{path}: expected OpenCV's XML, got a document type")
        root = ElementTree.fromstring(data)
    except ElementTree.ParseError as error:
        raise DatasetError(f"{path}: expected OpenCV's XML: {error}") from None
    left, right = (_matrix(path, root, name) for name in ("proj_matL", "proj_matR"))
    baseline = root.findtext("baselineLR")
    if baseline is None:
        raise DatasetError(f"{path}: expected <baselineLR> in millimetres, found none")
    rig = rectified_rig(
        path,
        size,
        fx=left[0, 0],
        fy=left[1, 1],
        cx=left[0, 2],
        cx_right=right[0, 2],
        cy=left[1, 2],
        baseline_m=abs(numbers(baseline, 1, f"{path}, baselineLR")[0]) / _MM_PER_M,
    )
    return rig, True


def _matrix(path: Path, root: ElementTree.Element, name: str) -> Matrix:
    words = root.findtext(f"{name}/data")
    if words is None:
        raise DatasetError(f"{path}: expected <{name}> with <data>, found none")
    return np.reshape(numbers(words, 12, f"{path}, {name}"), (3, 4))


def _truth(path: Path, mask_path: Path) -> Truth:
    offset_px = known_offsets(read_npy(path, "disparity"))
    return Truth(offset_px, visible=read_mask(mask_path) if mask_path.is_file() else None)
