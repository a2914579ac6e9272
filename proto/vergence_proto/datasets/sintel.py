"""MPI Sintel stereo: ``sintel:ROOT/training/final_left/alley_1`` (or ``clean_left``).

::

    ROOT/training/clean_left clean_right/alley_1/frame_0001.png     1024x436; final_ likewise
    ROOT/training/disparities/alley_1/frame_0001.png                RGB: 4 R + G / 2^6 + B / 2^14
    ROOT/training/occlusions outofframe/alley_1/frame_0001.png      not 0: the right camera does
                                                                    not see it
    ROOT/training/camdata_left/alley_1/frame_0001.cam               of the depth training data

A .cam file is the float32 202021.25, then in float64 K [3, 3] and camera_from_world [3, 4], OpenCV
axes. The baseline is 0.1 m. Without .cam files there are no poses and the rig is nominal.
"""

import struct
from functools import partial
from pathlib import Path

import numpy as np

from vergence_proto.datasets.files import DatasetError, existing
from vergence_proto.datasets.images import read_stored
from vergence_proto.datasets.listing import found, image_beside, images, number_in
from vergence_proto.datasets.packings import nominal_rig, read_mask, size_of
from vergence_proto.datasets.poses import checked_pose
from vergence_proto.datasets.source import (
    FrameFiles,
    StereoSource,
    Truth,
    nominal_ns,
    rectified_rig,
)
from vergence_proto.geometry import Matrix, Pose

_PASSES = ("clean_left", "final_left")
_BASELINE_M = 0.1
_FPS = 24.0  # the film's
_CAM_TAG = 202021.25
_CAM_BYTES = 4 + 8 * (9 + 12)
_SAME_FOCAL = 1e-3  # share of a change that is a rounding and no zoom


def find(root: Path) -> list[Path]:
    """List every scene in or under ``root``, of either pass."""
    if root.parent.name in _PASSES:
        return [root] if images(root) else []
    passes = [root] if root.name in _PASSES else []
    passes += [folder for name in _PASSES for folder in found(root, name)]
    return [scene for each in passes for scene in found(each, "*") if images(scene)]


def open_path(path: Path) -> StereoSource:
    """Open one scene; calibration and poses are read now.

    Raises DatasetError: a file is missing or wrong.
    """
    if path.parent.name not in _PASSES:
        raise DatasetError(f"{path}: expected a scene in {' or '.join(_PASSES)}")
    lefts = images(path)
    if not lefts:
        raise DatasetError(f"{path}: expected images frame_%04d.png, found none")
    split, scene = path.parent.parent, path.name
    right = path.parent.with_name(path.parent.name.replace("left", "right")) / scene
    cameras = {
        number_in(each): _read_camera(each)
        for each in found(split / "camdata_left" / scene, "*.cam")
    }
    matrices = [matrix for matrix, _ in cameras.values()]
    size = size_of(*lefts)
    if matrices:
        k = matrices[0]
        rig = rectified_rig(
            split / "camdata_left" / scene,
            size,
            fx=k[0, 0],
            fy=k[1, 1],
            cx=k[0, 2],
            cy=k[1, 2],
            baseline_m=_BASELINE_M,
        )
    else:
        rig = nominal_rig(path, size)
    constant = all(np.allclose(each, matrices[0], rtol=_SAME_FOCAL) for each in matrices)
    files = [
        FrameFiles(
            left,
            image_beside(left, right, left.stem),
            nominal_ns(index, _FPS),
            cameras[number_in(left)][1] if number_in(left) in cameras else None,
            partial(_truth, split, Path(scene) / f"{left.stem}.png")
            if (split / "disparities" / scene / f"{left.stem}.png").is_file()
            else None,
        )
        for index, left in enumerate(lefts)
    ]
    return StereoSource(scene, rig, _FPS, files, metric=bool(matrices) and constant)


def _read_camera(path: Path) -> tuple[Matrix, Pose]:
    """K and world_from_left."""
    data = existing(path, "Sintel's camera").read_bytes()
    if len(data) != _CAM_BYTES or struct.unpack_from("<f", data)[0] != _CAM_TAG:
        raise DatasetError(
            f"{path}: expected {_CAM_BYTES} bytes that start with the float {_CAM_TAG}, "
            f"got {len(data)} bytes starting {data[:4]!r}"
        )
    values = np.frombuffer(data, "<f8", offset=4)
    camera_from_world = checked_pose(values[9:].reshape(3, 4), str(path))
    return values[:9].reshape(3, 3).copy(), camera_from_world.inverse()


def _truth(split: Path, name: Path) -> Truth:
    path = split / "disparities" / name
    stored = read_stored(path)
    if stored.dtype != np.uint8 or stored.ndim != 3 or stored.shape[2] != 3:
        raise DatasetError(
            f"{path}: expected disparity packed in RGB, 8 bits each, "
            f"got {stored.dtype} {list(stored.shape)}"
        )
    blue, green, red = (stored[..., k].astype(np.float32) for k in range(3))
    offset_px = np.asarray(4 * red + green / 2**6 + blue / 2**14, np.float32)
    hidden = [
        read_mask(split / kind / name)
        for kind in ("occlusions", "outofframe")
        if (split / kind / name).is_file()
    ]
    return Truth(offset_px, visible=~np.logical_or.reduce(hidden) if hidden else None)
