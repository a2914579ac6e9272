"""EuRoC, TUM-VI and others in the ASL layout: ``euroc:ROOT/MH_01_easy`` or ``.../mav0``.

::

    mav0/cam0 cam1/data.csv           "#timestamp [ns],filename", images in data/
    mav0/cam0 cam1/sensor.yaml        T_BS (camera to body), resolution, intrinsics, distortion
    mav0/state_groundtruth_estimate0/data.csv    (TUM-VI: mocap0) timestamp, p, q as w x y z

The pair is not rectified, so the rig includes the distortion. Poses of the body are interpolated
to the times of the images. An image before, after or in a gap of the ground truth has no pose.
Rows may be in any order, and both images of a pair may have stamps up to half a frame apart.
Without ``data.csv`` the names of the images are their stamps.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PureWindowsPath

import numpy as np

from vergence_proto.calibration import euroc as calibration
from vergence_proto.calibration.fields import read_fields
from vergence_proto.datasets.files import DatasetError, numbers
from vergence_proto.datasets.listing import found, image_beside, images
from vergence_proto.datasets.poses import checked_orientation, interpolated
from vergence_proto.datasets.source import FrameFiles, StereoSource
from vergence_proto.datasets.stamps import pairs_of, read_stamped
from vergence_proto.errors import BadCalibration
from vergence_proto.geometry import Matrix, Pose

_TRUTHS = ("state_groundtruth_estimate0", "mocap0")
_APART_MS = 1.0  # more is worth a note: a moving camera is elsewhere by then


def find(root: Path) -> list[Path]:
    """List every ``mav0`` in or under ``root``."""
    return [path.parent.parent for path in found(root, "cam0/sensor.yaml")]


def open_path(path: Path) -> StereoSource:
    """Open one sequence; calibration and poses are read now.

    Raises DatasetError: a file is missing or wrong.
    """
    mav = path / "mav0" if (path / "mav0").is_dir() else path
    files = tuple(mav / camera / "sensor.yaml" for camera in ("cam0", "cam1"))
    try:
        left, right = (read_fields(file, opencv=False) for file in files)
        rig, body_from_left = calibration.read(left, right).rig, left.pose("T_BS")
    except BadCalibration as error:
        raise DatasetError(str(error)) from None
    lefts, rights = (_read_images(mav / camera) for camera in ("cam0", "cam1"))
    pairs_ns = pairs_of([*lefts], [*rights])
    if not pairs_ns:
        raise DatasetError(
            f"{mav}: no image of cam1 is less than half a frame from one of cam0; "
            "are the stamps those of one clock?"
        )
    times_ns = [left_ns for left_ns, _ in pairs_ns]
    poses, notes = _body_poses(mav, times_ns)
    frames = [
        FrameFiles(
            lefts[left_ns],
            rights[right_ns],
            left_ns,
            None if world_from_body is None else world_from_body @ body_from_left,
        )
        for (left_ns, right_ns), world_from_body in zip(pairs_ns, poses, strict=True)
    ]
    fps = 1e9 / float(np.median(np.diff(times_ns))) if len(times_ns) > 1 else None
    name = mav.parent.name if mav.name == "mav0" else mav.name
    notes = (*_notes_on_pairs(mav, lefts, rights, pairs_ns), *notes)
    return StereoSource(name, rig, fps, frames, notes)


def _notes_on_pairs(
    mav: Path,
    lefts: Mapping[int, Path],
    rights: Mapping[int, Path],
    pairs_ns: Sequence[tuple[int, int]],
) -> Iterator[str]:
    alone = len(lefts) + len(rights) - 2 * len(pairs_ns)
    if alone:
        yield f"{mav}: {alone} images have no partner in the other camera and are left out"
    apart_ms = max(abs(right_ns - left_ns) for left_ns, right_ns in pairs_ns) / 1e6
    if apart_ms > _APART_MS:
        yield f"{mav}: left and right images are up to {apart_ms:.1f} ms apart"


def _read_images(camera: Path) -> Mapping[int, Path]:
    folder, path = camera / "data", camera / "data.csv"
    if not path.exists():
        return {int(image.stem): image for image in images(folder, r"\d+")}
    names = read_stamped(path, "timestamp [ns],filename")
    stems = {time_ns: PureWindowsPath(name.strip(" ,")) for time_ns, name in names.items()}
    return {
        time_ns: image_beside(Path(name.name), folder, name.stem) for time_ns, name in stems.items()
    }


def _body_poses(mav: Path, times_ns: list[int]) -> tuple[list[Pose | None], tuple[str, ...]]:
    """Return world_from_body at each time, and notes on what does not fit."""
    path = next((mav / name / "data.csv" for name in _TRUTHS if (mav / name).is_dir()), None)
    if path is None:
        return [None] * len(times_ns), ()
    rows = read_stamped(path, "timestamp, p x y z, q w x y z")
    known = {time_ns: _body_pose(rest, f"{path}, {time_ns}") for time_ns, rest in rows.items()}
    tracked = {time_ns: pose for time_ns, pose in known.items() if pose is not None}
    known_ns, known_poses = [*tracked], [*tracked.values()]
    poses = [interpolated(known_ns, known_poses, time_ns) for time_ns in times_ns]
    if any(pose is not None for pose in poses):
        return poses, ()
    return poses, (
        f"{path}: no image has a pose, since none lies within the trajectory's times; "
        "are the stamps those of one clock?",
    )


def _body_pose(words: str, origin: str) -> Pose | None:
    """Read p x y z, q w x y z; None: tracking was lost (NaN)."""
    values: Matrix = np.array(numbers(words, None, origin))
    if values.size < 7:
        raise DatasetError(f"{origin}: expected p x y z, q w x y z, got {values.size} numbers")
    if not np.isfinite(values[:7]).all():
        return None
    return Pose.from_xyzw(checked_orientation(values[[4, 5, 6, 3]], origin), values[:3])
