"""The doctor of recordings: each mistake made in the bundled room is named, and no other."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from vergence import source_check
from vergence.source_check import Advice, Mistake, check_source
from vergence_proto.datasets import StereoSource, open_source
from vergence_proto.datasets.poses import interpolated
from vergence_proto.datasets.source import FrameFiles
from vergence_proto.geometry import Axes, Pose
from vergence_proto.types import Image, Intrinsics

ROOM = Path(__file__).parents[2] / "client/vergence/sample/room"
# Pairs of frames to look at: few, which is quick, but some mistakes show in some motion only.
PAIRS = 2

Change = Callable[[FrameFiles], FrameFiles]


@pytest.fixture(autouse=True, scope="module")
def features_once() -> Iterator[None]:
    """The features of an image are found once for all tests: finding them takes nearly all time."""
    found: dict[tuple[bytes, str, bytes], object] = {}
    find = vars(source_check)["_features"]

    def found_before(
        detector: cv2.SIFT, image: Image, camera: Intrinsics, turn: NDArray[np.float64]
    ) -> object:
        key = image.tobytes(), repr(camera), turn.tobytes()
        if key not in found:
            found[key] = find(detector, image, camera, turn)
        return found[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(source_check, "_features", found_before)
        yield


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


@pytest.mark.parametrize(
    ("source", "mistake", "words"),
    [
        (swapped, Mistake.SWAPPED_EYES, "exchange left and right"),
        (lambda: posed(Pose.inverse), Mistake.INVERTED_POSES, "store their inverses"),
        (lambda: posed(Axes.OPENXR.from_opencv), Mistake.AXES, "axes OPENXR"),
        (lambda: posed(Axes.ROS.from_opencv), Mistake.AXES, "axes ROS"),
        (poses_40_ms_late, Mistake.POSE_TIME, "-40 ms"),
        (right_images_a_frame_later, Mistake.EYES_APART_IN_TIME, "33 ms (1 frame) after"),
        (baseline_too_long, Mistake.BASELINE, "not 120 mm"),
        (focal_length_too_long, Mistake.FOCAL_LENGTH, "not 432 px"),
    ],
)
def test_a_mistake_is_named(
    source: Callable[[], StereoSource], mistake: Mistake, words: str
) -> None:
    few = mistake not in (Mistake.POSE_TIME, Mistake.EYES_APART_IN_TIME)
    (advice,) = check_source(source(), pairs=1 if few else PAIRS)
    assert advice.mistake is mistake
    assert words in advice.sentence


def test_rows_that_do_not_correspond_are_named(tmp_path: Path) -> None:
    def lowered(files: FrameFiles) -> FrameFiles:
        image = cv2.imread(str(files.right))
        assert image is not None
        path = tmp_path / f"{files.right.stem}.png"
        cv2.imwrite(str(path), np.roll(image, 3, axis=0))
        return replace(files, right=path)

    source = replace(room(), files=[lowered(each) for each in room().files[:2]])
    (advice,) = check_source(source, pairs=1)
    assert advice.mistake is Mistake.VERTICAL
    assert "3.0 px higher in the left image" in advice.sentence


def test_a_good_recording_is_left_alone() -> None:
    assert check_source(room(), pairs=PAIRS) == []
    without_poses = changed(lambda each: replace(each, world_from_left=None))
    assert check_source(without_poses, pairs=1) == []
    assert check_source(replace(room(), files=room().files[:1]), pairs=1) == []


def test_images_without_any_feature_say_nothing(tmp_path: Path) -> None:
    path = tmp_path / "grey.png"
    cv2.imwrite(str(path), np.full((480, 640), 90, np.uint8))
    blank = changed(lambda each: replace(each, left=path, right=path))
    assert check_source(blank, pairs=1) == []


def test_advice_is_one_sentence_with_a_remedy() -> None:
    advice = check_source(swapped(), pairs=1)
    assert isinstance(advice[0], Advice)
    assert ":" in advice[0].sentence
    assert "\n" not in advice[0].sentence
