"""Spring: ``spring:ROOT/train/0001``.

::

    ROOT/train/0001/frame_left frame_right/frame_left_%04d.png   1920x1080, numbered from 1
    ROOT/train/0001/disp1_left/disp1_left_%04d.dsp5              HDF5, "disparity", of 3840x2160
    ROOT/train/0001/cam_data/intrinsics.txt                      fx fy cx cy per frame
    ROOT/train/0001/cam_data/extrinsics.txt                      camera_from_world, 4x4 per frame

Truth has twice the images' resolution but counts pixels of the images; of each 2x2 the first is
taken, as the data set's own tools do. The baseline is 0.065 m. Reading truth needs h5py.
"""

import importlib
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vergence_proto.datasets.files import DatasetError, existing
from vergence_proto.datasets.listing import found, image_beside, images, number_in, read_rows
from vergence_proto.datasets.packings import nominal_rig, size_of
from vergence_proto.datasets.poses import tracked_pose
from vergence_proto.datasets.source import (
    FrameFiles,
    StereoSource,
    Truth,
    nominal_ns,
    rectified_rig,
)
from vergence_proto.geometry import Pose
from vergence_proto.types import StereoRig

_BASELINE_M = 0.065
_SAME_FOCAL = 1e-3  # share of a change that is a rounding and no zoom


def find(root: Path) -> list[Path]:
    """List every sequence in or under ``root``."""
    return [
        folder.parent
        for folder in found(root, "frame_left")
        if (folder.parent / "frame_right").is_dir()
    ]


def open_path(path: Path) -> StereoSource:
    """Open one sequence; calibration and poses are read now.

    Raises DatasetError: a file is missing or wrong.
    """
    lefts = images(path / "frame_left", r"frame_left_\d+")
    if not lefts:
        raise DatasetError(
            f"{path / 'frame_left'}: expected images frame_left_%04d.png, found none"
        )
    poses = _read_poses(path / "cam_data" / "extrinsics.txt")
    rig, metric = _read_rig(path / "cam_data" / "intrinsics.txt", size_of(*lefts))
    files = []
    for index, left in enumerate(lefts):
        digits = left.stem.removeprefix("frame_left_")
        truth = path / "disp1_left" / f"disp1_left_{digits}.dsp5"
        files.append(
            FrameFiles(
                left,
                image_beside(left, path / "frame_right", f"frame_right_{digits}"),
                nominal_ns(index, None),
                poses.get(number_in(left)),
                partial(_truth, truth) if truth.is_file() else None,
            )
        )
    return StereoSource(path.name, rig, None, files, metric=metric)


def _read_poses(path: Path) -> dict[int, Pose]:
    """Read world_from_left of each frame number."""
    if not path.exists():
        return {}
    rows = read_rows(path, 16, "camera_from_world, 16 numbers per line")
    poses = {
        number: tracked_pose(np.reshape(row, (4, 4)), f"{path}, line {number}")
        for number, row in enumerate(rows, start=1)
    }
    return {number: pose.inverse() for number, pose in poses.items() if pose is not None}


def _read_rig(path: Path, size: tuple[int, int]) -> tuple[StereoRig, bool]:
    if not path.exists():
        return nominal_rig(path, size), False
    rows = read_rows(path, 4, "fx fy cx cy per line")
    if not rows:
        raise DatasetError(f"{path}: expected fx fy cx cy per line, got an empty file")
    fx, fy, cx, cy = rows[0]
    rig = rectified_rig(path, size, fx=fx, fy=fy, cx=cx, cy=cy, baseline_m=_BASELINE_M)
    # One rig describes a whole source: of a zoom only the disparities stay right.
    return rig, bool(np.allclose(rows, rows[0], rtol=_SAME_FOCAL))


def _truth(path: Path) -> Truth:
    offset_px = _read_dsp5(path)[::2, ::2].astype(np.float32)
    offset_px[~np.isfinite(offset_px)] = np.nan
    return Truth(offset_px)


def _read_dsp5(path: Path) -> NDArray[Any]:
    existing(path, "Spring's disparity")
    try:
        h5py: Any = importlib.import_module("h5py")
    except ImportError:
        raise DatasetError(
            f"{path}: reading Spring's disparity needs h5py, which is not installed: "
            "pip install h5py"
        ) from None
    try:
        with h5py.File(path, "r") as file:
            stored = np.asarray(file["disparity"])
    except (OSError, KeyError) as error:
        raise DatasetError(f"{path}: expected HDF5 with 'disparity': {error}") from None
    if stored.ndim != 2:
        raise DatasetError(f"{path}: expected disparity [H, W], got {list(stored.shape)}")
    return stored
