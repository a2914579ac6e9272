"""EuRoC, TUM-VI and others in the ASL layout: ``euroc:ROOT/MH_01_easy`` or ``.../mav0``.

::

    mav0/cam0 cam1/data.csv           "#timestamp [ns],filename", images in data/
    mav0/cam0 cam1/sensor.yaml        T_BS (camera to body), resolution, intrinsics, distortion
    mav0/state_groundtruth_estimate0/data.csv    (TUM-VI: mocap0) timestamp, p, q as w x y z

The pair is not rectified, so the rig includes the distortion. Poses of the body are interpolated
to the times of the images. An image before, after or in a gap of the ground truth has no pose.
"""

import re
from pathlib import Path

import numpy as np

from vergence_proto.datasets.files import DatasetError, numbers, read_text
from vergence_proto.datasets.poses import checked_orientation, checked_pose, interpolated
from vergence_proto.datasets.source import FrameFiles, StereoSource
from vergence_proto.errors import BadCalibration
from vergence_proto.geometry import Matrix, Pose
from vergence_proto.types import Distortion, Intrinsics, StereoRig

_TRUTHS = ("state_groundtruth_estimate0", "mocap0")
_DISTORTIONS = {
    "radial-tangential": Distortion.BROWN_CONRADY,
    "equidistant": Distortion.KANNALA_BRANDT,
}


def find(root: Path) -> list[Path]:
    """List every ``mav0`` in or under ``root``."""
    return sorted(path.parent.parent for path in root.rglob("cam0/sensor.yaml"))


def open_path(path: Path) -> StereoSource:
    """Open one sequence; calibration and poses are read now.

    Raises DatasetError: a file is missing or wrong.
    """
    mav = path / "mav0" if (path / "mav0").is_dir() else path
    body_from_left, left = _read_camera(mav / "cam0" / "sensor.yaml")
    body_from_right, right = _read_camera(mav / "cam1" / "sensor.yaml")
    try:
        rig = StereoRig(left, right, body_from_left.inverse() @ body_from_right)
    except BadCalibration as error:
        raise DatasetError(f"{mav / 'cam1' / 'sensor.yaml'}: {error}") from None
    lefts, rights = (_read_images(mav / camera) for camera in ("cam0", "cam1"))
    times_ns = sorted(lefts.keys() & rights.keys())
    if not times_ns:
        raise DatasetError(f"{mav}: cam0 and cam1 have no timestamp in common")
    poses = _body_poses(mav, times_ns)
    files = [
        FrameFiles(
            lefts[time_ns],
            rights[time_ns],
            time_ns,
            None if world_from_body is None else world_from_body @ body_from_left,
        )
        for time_ns, world_from_body in zip(times_ns, poses, strict=True)
    ]
    fps = 1e9 / float(np.median(np.diff(times_ns))) if len(times_ns) > 1 else None
    name = mav.parent.name if mav.name == "mav0" else mav.name
    return StereoSource(name, rig, fps, files)


def _read_camera(path: Path) -> tuple[Pose, Intrinsics]:
    """Read body_from_camera and the intrinsics."""
    text = read_text(path, "a camera's calibration")
    body_from_camera = checked_pose(
        np.reshape(_list(path, text, "data", 16), (4, 4)), f"{path}, T_BS"
    )
    width, height = _list(path, text, "resolution", 2)
    model = re.search(r"^distortion_model:\s*([\w-]+)", text, re.MULTILINE)
    if model is None or model[1] not in _DISTORTIONS:
        raise DatasetError(
            f"{path}: expected distortion_model {' or '.join(_DISTORTIONS)}, "
            f"got {model[1] if model else 'none'}"
        )
    fx, fy, cx, cy = _list(path, text, "intrinsics", 4)
    coefficients = tuple(_list(path, text, "distortion_coefficients", None))
    try:
        return body_from_camera, Intrinsics(
            int(width), int(height), fx, fy, cx, cy, _DISTORTIONS[model[1]], coefficients
        )
    except BadCalibration as error:
        raise DatasetError(f"{path}: {error}") from None


def _list(path: Path, text: str, key: str, count: int | None) -> list[float]:
    """Read a list of numbers, on one line or several; these files use only a little of YAML."""
    found = re.search(rf"^\s*{key}:\s*\[([^\]]*)\]", text, re.MULTILINE)
    if found is None:
        raise DatasetError(f"{path}: expected {key}: [...], found none")
    return numbers(found[1], count, f"{path}, {key}")


def _read_images(camera: Path) -> dict[int, Path]:
    path = camera / "data.csv"
    images = {}
    for line in read_text(path, "timestamp [ns],filename").splitlines():
        if line.strip() and not line.startswith("#"):
            time_ns, comma, name = line.partition(",")
            if not comma or not time_ns.strip().isdecimal():
                raise DatasetError(f"{path}: expected 'timestamp,filename', got {line!r}")
            images[int(time_ns)] = camera / "data" / name.strip()
    return images


def _body_poses(mav: Path, times_ns: list[int]) -> list[Pose | None]:
    path = next((mav / name / "data.csv" for name in _TRUTHS if (mav / name).is_dir()), None)
    if path is None:
        return [None] * len(times_ns)
    lines = read_text(path, "timestamp, p x y z, q w x y z").splitlines()
    pose_times_ns, poses = [], []
    for line in lines:
        if not line.strip() or line.startswith("#"):
            continue
        # The time is parsed separately: 19 digits of nanoseconds do not fit a float.
        time_ns, _, rest = line.partition(",")
        origin = f"{path}, {time_ns}"
        if not time_ns.strip().isdecimal():
            raise DatasetError(f"{path}: expected a timestamp in ns, got {time_ns!r}")
        values: Matrix = np.array(numbers(rest, None, origin))
        if values.size < 7:
            raise DatasetError(f"{origin}: expected p x y z, q w x y z, got {values.size} numbers")
        orientation_xyzw = checked_orientation(values[[4, 5, 6, 3]], origin)
        pose_times_ns.append(int(time_ns))
        poses.append(Pose.from_xyzw(orientation_xyzw, values[:3]))
    return [interpolated(pose_times_ns, poses, time_ns) for time_ns in times_ns]
