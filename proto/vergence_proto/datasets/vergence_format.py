"""The project's own data set format: a folder with one rectified sequence, or one pair.

::

    calib.json                      fx, fy, cx, cy, baseline_m, width, height (and, where they
                                    differ, cx_right; and fps)
    frame_0000_left.EXT             png, webp, jpg or jpeg, numbered from 0
    frame_0000_right.EXT
    poses.txt                       optional: one 3x4 camera-to-world matrix per line, left camera,
                                    OpenCV axes, metres
    frame_0000_gt.npz               optional truth: disp uint16 = round(64 * px), 0 unknown; vis and
                                    nonspecular, np.packbits(axis=1) masks
    frame_0000_ref.npz              or a sparse reference: u, v, disp

A pair has ``left.EXT``, ``right.EXT`` and, for truth, ``gt.npz`` with disp float32, NaN unknown.
Disparities are pixel offsets u_left - u_right. Null intrinsics mean unknown. A nominal camera then
takes their place: its focal length equals its width (53 degrees), its baseline is 0.1 m. Disparity
does not depend on it; depth does. Of a sequence only some frames may be there: each has the pose
of its number.
"""

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vergence_proto.datasets.files import (
    DatasetError,
    JsonObject,
    npz_arrays,
    object_number,
    read_object,
)
from vergence_proto.datasets.listing import (
    IMAGES,
    found,
    image_beside,
    images,
    notes_on_poses,
    rows_of_frames,
)
from vergence_proto.datasets.packings import known_offsets, nominal_rig
from vergence_proto.datasets.poses import read_matrix_poses
from vergence_proto.datasets.source import (
    FrameFiles,
    StereoSource,
    Truth,
    nominal_ns,
    rectified_rig,
)
from vergence_proto.geometry import Pose
from vergence_proto.types import StereoRig

_FRAME = r"frame_\d+_"
_TRUTH_STEPS_PER_PX = np.float32(64)


def find(root: Path) -> list[Path]:
    """List every sequence and pair in or under ``root``."""
    return [path.parent for path in found(root, "calib.json") if _has_images(path.parent)]


def open_path(path: Path) -> StereoSource:
    """Open one sequence or pair; calibration and poses are read now.

    Raises DatasetError: a file is missing or wrong.
    """
    origin = path / "calib.json"
    calib = read_object(origin, "the calibration of a vergence: sequence or pair")
    rig, metric = _rig(origin, calib)
    if _image(path, "left").is_file():
        return StereoSource(path.name, rig, None, [_pair(path)], metric=metric)
    fps = object_number(origin, calib, "fps") if calib.get("fps") is not None else None
    if fps is not None and fps <= 0:
        raise DatasetError(f"{origin}: expected a positive fps, got {fps}")
    files, notes = _frames(path, rig, fps)
    return StereoSource(path.name, rig, fps, files, notes, metric)


def _has_images(path: Path) -> bool:
    return _image(path, "left").is_file() or bool(images(path, f"{_FRAME}left"))


def _image(path: Path, name: str) -> Path:
    return image_beside(Path("any.png"), path, name)


def _rig(path: Path, calib: JsonObject) -> tuple[StereoRig, bool]:
    width, height = (int(object_number(path, calib, key)) for key in ("width", "height"))
    if calib.get("fx", 0) is None or calib.get("baseline_m", 0) is None:
        return nominal_rig(path, (width, height)), False
    known = {key: object_number(path, calib, key) for key in ("fx", "cx", "cy", "baseline_m")}
    extra = {key: object_number(path, calib, key) for key in ("fy", "cx_right") if key in calib}
    return rectified_rig(path, (width, height), **known, **extra), True


def _pair(path: Path) -> FrameFiles:
    left, right, truth = _image(path, "left"), _image(path, "right"), path / "gt.npz"
    if not right.is_file():
        raise DatasetError(f"{path / 'right'}: not found as {' or '.join(IMAGES)}")
    return FrameFiles(
        left,
        right,
        capture_ns=0,
        read_truth=partial(_pair_truth, truth) if truth.exists() else None,
    )


def _frames(
    path: Path, rig: StereoRig, fps: float | None
) -> tuple[list[FrameFiles], tuple[str, ...]]:
    """The frames of which one image is there at least, and notes on what is missing."""
    stems = {
        int(each.stem.split("_")[1]): each.stem.rpartition("_")[0]
        for each in images(path, f"{_FRAME}(left|right)")
    }
    if not stems:
        raise DatasetError(
            f"{path}: expected frame_0000_left and on, or left and right; found none"
        )
    frames = sorted(stems)
    trajectory = path / "poses.txt"
    poses: list[Pose | None] = [None] * len(frames)
    notes: tuple[str, ...] = ()
    if trajectory.exists():
        rows = rows_of_frames(read_matrix_poses(trajectory), frames)
        poses = list(rows)
        notes = notes_on_poses(trajectory, poses)
    gaps = frames[-1] + 1 - frames[0] - len(frames)
    if gaps:
        notes += (f"{path}: {gaps} frames between the first and the last are missing",)
    files = []
    for number, world_from_left in zip(frames, poses, strict=True):
        stem = stems[number]
        dense, sparse = path / f"{stem}_gt.npz", path / f"{stem}_ref.npz"
        read_truth = None
        if dense.exists():
            read_truth = partial(_dense_truth, dense)
        elif sparse.exists():
            read_truth = partial(_sparse_truth, sparse, (rig.left.height, rig.left.width))
        left, right = (_image(path, f"{stem}_{side}") for side in ("left", "right"))
        files.append(FrameFiles(left, right, nominal_ns(number, fps), world_from_left, read_truth))
    return files, notes


def _pair_truth(path: Path) -> Truth:
    return Truth(known_offsets(npz_arrays(path, "disp")["disp"]))


def _dense_truth(path: Path) -> Truth:
    arrays = npz_arrays(path, "disp")
    stored = arrays["disp"]
    if stored.dtype != np.uint16 or stored.ndim != 2:
        raise DatasetError(f"{path}: expected disp as uint16 [H, W], got {stored.dtype}")
    offset_px = stored / _TRUTH_STEPS_PER_PX
    offset_px[stored == 0] = np.nan
    return Truth(
        offset_px.astype(np.float32),
        mask=_unpacked(path, arrays, "nonspecular", stored.shape),
        visible=_unpacked(path, arrays, "vis", stored.shape),
    )


def _unpacked(
    path: Path, arrays: Mapping[str, NDArray[np.generic]], name: str, shape: tuple[int, ...]
) -> NDArray[np.bool_] | None:
    if name not in arrays:
        return None
    height, width = shape
    packed = arrays[name]
    if packed.dtype != np.uint8 or packed.shape != (height, -(-width // 8)):
        raise DatasetError(
            f"{path}: expected {name} as np.packbits(axis=1) of {width}x{height}, "
            f"got {packed.dtype} {list(packed.shape)}"
        )
    return np.unpackbits(packed.astype(np.uint8), axis=1, count=width).astype(np.bool_)


def _sparse_truth(path: Path, shape: tuple[int, int]) -> Truth:
    arrays = npz_arrays(path, "u", "v", "disp")
    u, v = np.rint(arrays["u"]).astype(int), np.rint(arrays["v"]).astype(int)
    if not u.shape == v.shape == arrays["disp"].shape:
        raise DatasetError(f"{path}: expected u, v and disp of one length")
    inside = (u >= 0) & (v >= 0) & (u < shape[1]) & (v < shape[0])
    offset_px = np.full(shape, np.nan, np.float32)
    offset_px[v[inside], u[inside]] = arrays["disp"][inside]
    return Truth(offset_px)
