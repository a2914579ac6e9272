"""The bundled room as it is, and with each mistake that a recording can have."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from vergence.source_check import Mistake
from vergence_proto.datasets import StereoSource, open_source
from vergence_proto.datasets.poses import interpolated
from vergence_proto.datasets.source import FrameFiles
from vergence_proto.geometry import Axes, Pose
from vergence_proto.types import Intrinsics

ROOM = Path(__file__).parents[2] / "client/vergence/sample/room"

Change = Callable[[FrameFiles], FrameFiles]


@cache
def room() -> StereoSource:
    return open_source(f"vergence:{ROOM}").without_truth()


def changed(change: Change) -> StereoSource:
    return replace(room(), files=[change(each) for each in room().files])


def posed(change: Callable[[Pose], Pose]) -> StereoSource:
    def with_pose(files: FrameFiles) -> FrameFiles:
        assert files.world_from_left is not None
        return replace(files, world_from_left=change(files.world_from_left))

    return changed(with_pose)


def swapped() -> StereoSource:
    return changed(lambda each: replace(each, left=each.right, right=each.left))


def poses_40_ms_late() -> StereoSource:
    times_ns = [each.capture_ns for each in room().files]
    poses = [each.world_from_left for each in room().files if each.world_from_left is not None]

    def late(files: FrameFiles) -> FrameFiles:
        pose = interpolated(times_ns, poses, files.capture_ns + 40_000_000)
        return replace(files, world_from_left=pose or poses[-1])

    return changed(late)


def right_images_a_frame_later() -> StereoSource:
    rights = [each.right for each in room().files]
    later = dict(zip(rights, rights[1:] + rights[-1:], strict=True))
    return changed(lambda each: replace(each, right=later[each.right]))


def baseline_too_long() -> StereoSource:
    rig = room().rig
    pose = Pose(np.eye(3), rig.left_from_right.translation_m * 1.2)
    return replace(room(), rig=replace(rig, left_from_right=pose))


def focal_length_too_long() -> StereoSource:
    def longer(camera: Intrinsics) -> Intrinsics:
        return replace(camera, fx=camera.fx * 1.08, fy=camera.fy * 1.08)

    rig = room().rig
    return replace(room(), rig=replace(rig, left=longer(rig.left), right=longer(rig.right)))


def rows_apart(folder: Path, *, frames: int) -> StereoSource:
    """The first frames, with right images that are written to ``folder`` three rows lower."""

    def lowered(files: FrameFiles) -> FrameFiles:
        image = cv2.imread(str(files.right))
        assert image is not None
        path = folder / f"{files.right.stem}.png"
        cv2.imwrite(str(path), np.roll(image, 3, axis=0))
        return replace(files, right=path)

    return replace(room(), files=[lowered(each) for each in room().files[:frames]])


def write_sequence(source: StereoSource, folder: Path) -> Path:
    """Write a recording as a ``vergence:`` sequence; its images are links."""
    folder.mkdir()
    camera = source.rig.left
    calib = {
        **{"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy, "fps": 30},
        **{"width": camera.width, "height": camera.height},
        "baseline_m": float(np.linalg.norm(source.rig.left_from_right.translation_m)),
    }
    (folder / "calib.json").write_text(json.dumps(calib))
    poses = []
    for index, files in enumerate(source.files):
        assert files.world_from_left is not None
        poses.append(files.world_from_left.matrix[:3].ravel())
        for side, image in (("left", files.left), ("right", files.right)):
            (folder / f"frame_{index:04d}_{side}{image.suffix}").symlink_to(image)
    np.savetxt(folder / "poses.txt", poses)
    return folder


MISTAKES: list[tuple[Callable[[], StereoSource], Mistake, str]] = [
    (swapped, Mistake.SWAPPED_EYES, "exchange left and right"),
    (lambda: posed(Pose.inverse), Mistake.INVERTED_POSES, "store their inverses"),
    (lambda: posed(Axes.OPENXR.from_opencv), Mistake.AXES, "axes OPENXR"),
    (lambda: posed(Axes.ROS.from_opencv), Mistake.AXES, "axes ROS"),
    (poses_40_ms_late, Mistake.POSE_TIME, "-40 ms"),
    (right_images_a_frame_later, Mistake.EYES_APART_IN_TIME, "33 ms (1 frame) after"),
    (baseline_too_long, Mistake.BASELINE, "not 120 mm"),
    (focal_length_too_long, Mistake.FOCAL_LENGTH, "not 432 px"),
]
"""The recordings, but for that of :func:`rows_apart`, the mistakes, and what is said of each."""
