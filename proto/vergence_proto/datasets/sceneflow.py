"""SceneFlow (FlyingThings3D, Driving, Monkaa), and others in its format (XR-Stereo).

A source is named ``sceneflow:ROOT/frames_finalpass/TRAIN/A/0000``. Add ``?fx=PIXELS`` for images
that are not SceneFlow's own 960x540 and have no ``intrinsics.json`` (our benchmark's have one)::

    ROOT/frames_cleanpass|frames_finalpass/REST/left right   %04d.png or .webp
    ROOT/disparity/REST/left                                 %04d.pfm, pixels of either sign
    ROOT/camera_data/REST/camera_data.txt                    "Frame N", then L and R: 4x4 per line

Camera-to-world matrices have Blender's camera axes: x right, y up, z back. World axes are
Blender's. SceneFlow states lengths in units of its own, not in metres. Without ``camera_data``
there are no poses, and the baseline is a nominal one.
"""

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np

from vergence_proto.datasets.files import (
    DatasetError,
    numbers,
    object_number,
    read_lines,
    read_object,
)
from vergence_proto.datasets.images import read_pfm
from vergence_proto.datasets.listing import found, image_beside, images
from vergence_proto.datasets.packings import known_offsets, read_mask, size_of
from vergence_proto.datasets.poses import checked_pose
from vergence_proto.datasets.source import (
    FrameFiles,
    StereoSource,
    Truth,
    nominal_ns,
    rectified_rig,
)
from vergence_proto.geometry import Pose

_PASSES = ("frames_cleanpass", "frames_finalpass")
_OWN_SIZE = (960, 540)
_OWN_FX = 1050.0  # a 35 mm lens
_OWN_FX_WIDE = {"15mm_focallength": 450.0}  # part of Driving
_NOMINAL_BASELINE_M = 1.0  # SceneFlow's, in its own units
_OPENCV_FROM_BLENDER_CAMERA = np.diag([1.0, -1.0, -1.0, 1.0])


def find(root: Path) -> list[Path]:
    """List every sequence of either pass in or under ``root``."""
    folders = (left.parent for left in found(root, "left") if left.is_dir())
    return [folder for folder in folders if any(part in _PASSES for part in folder.parts)]


def open_path(path: Path, *, fx: float | None = None) -> StereoSource:
    """Open one sequence. A frame that the camera data leaves out has no pose.

    Raises DatasetError: a file is missing or wrong, or ``fx`` (pixels) is needed and not given.
    """
    disparity, specular = (_beside(path, kind) / "left" for kind in ("disparity", "specular"))
    origin = _beside(path, "camera_data") / "camera_data.txt"
    cameras = _read_cameras(origin) if origin.is_file() else {}
    lefts = images(path / "left", r"\d+")
    if not lefts:
        raise DatasetError(f"{path / 'left'}: expected images %04d.png or .webp, found none")
    width, height = size_of(*lefts)
    own = (width, height) == _OWN_SIZE
    fps = None
    intrinsics = origin.with_name("intrinsics.json")
    if intrinsics.exists():
        known = read_object(intrinsics, "fx and fps")
        fx = fx or object_number(intrinsics, known, "fx")
        fps = object_number(intrinsics, known, "fps")
        if fps <= 0:
            raise DatasetError(f"{intrinsics}: expected a positive fps, got {fps}")
        own = False
    if fx is None and not own:
        raise DatasetError(
            f"{path}: images of {width}x{height} are not SceneFlow's own, and no file states "
            f"the focal length; add it: sceneflow:{path}?fx=PIXELS"
        )
    baseline_m = _NOMINAL_BASELINE_M
    for world_from_left, world_from_right in list(cameras.values())[:1]:
        baseline_m = (world_from_left.inverse() @ world_from_right).translation_m[0]
    rig = rectified_rig(
        origin,
        (width, height),
        fx=_own_fx(path) if fx is None else fx,
        cx=(width - 1) / 2,
        cy=(height - 1) / 2,
        baseline_m=baseline_m,
    )
    files = [
        FrameFiles(
            left,
            image_beside(left, path / "right", left.stem),
            nominal_ns(index, fps),
            cameras[int(left.stem)][0] if int(left.stem) in cameras else None,
            partial(_truth, disparity / f"{left.stem}.pfm", specular / f"{left.stem}.png")
            if (disparity / f"{left.stem}.pfm").is_file()
            else None,
        )
        for index, left in enumerate(lefts)
    ]
    return StereoSource(path.name, rig, fps, files, metric=bool(cameras) and not own)


def _beside(path: Path, kind: str) -> Path:
    """Return the folder with another kind of data of the same sequence."""
    for index, part in enumerate(path.parts):
        if part in _PASSES:
            return Path(*path.parts[:index], kind, *path.parts[index + 1 :])
    raise DatasetError(f"{path}: expected a sequence under {' or '.join(_PASSES)}")


def _own_fx(path: Path) -> float:
    return next((_OWN_FX_WIDE[part] for part in path.parts if part in _OWN_FX_WIDE), _OWN_FX)


def _read_cameras(path: Path) -> Mapping[int, tuple[Pose, Pose]]:
    """Map frame number to world_from_left and world_from_right, OpenCV camera axes."""
    cameras: dict[int, tuple[Pose, Pose]] = {}
    text = "\n".join(read_lines(path, "SceneFlow's camera data"))
    blocks = text.split("Frame")[1:]
    for block in blocks:
        lines = [line.split(maxsplit=1) for line in block.splitlines() if line.strip()]
        if [line[0] for line in lines[1:]] != ["L", "R"] or not lines[0][0].isdecimal():
            raise DatasetError(f"{path}: expected 'Frame N', 'L ...', 'R ...', got {block[:60]!r}")
        number = int(lines[0][0])
        left, right = (_pose(line[-1], f"{path}, frame {number}") for line in lines[1:])
        cameras[number] = left, right
    if not cameras:
        raise DatasetError(f"{path}: expected blocks of 'Frame N', found none")
    return cameras


def _pose(words: str, origin: str) -> Pose:
    world_from_blender = np.reshape(numbers(words, 16, origin), (4, 4))
    return checked_pose(world_from_blender @ _OPENCV_FROM_BLENDER_CAMERA, origin)


def _truth(path: Path, specular: Path) -> Truth:
    mask = ~read_mask(specular) if specular.is_file() else None
    return Truth(known_offsets(read_pfm(path)), mask)
