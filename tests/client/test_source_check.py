"""The doctor of recordings: each mistake made in the bundled room is named, and no other."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.support.mistaken_rooms import MISTAKES, changed, room, rows_apart, swapped
from vergence import source_check
from vergence.source_check import Advice, Mistake, check_source
from vergence_proto.datasets import StereoSource
from vergence_proto.types import Image, Intrinsics

# Pairs of frames to look at: few, which is quick, but some mistakes show in some motion only.
PAIRS = 2


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


@pytest.mark.parametrize(("source", "mistake", "words"), MISTAKES)
def test_a_mistake_is_named(
    source: Callable[[], StereoSource], mistake: Mistake, words: str
) -> None:
    few = mistake not in (Mistake.POSE_TIME, Mistake.EYES_APART_IN_TIME)
    (advice,) = check_source(source(), pairs=1 if few else PAIRS)
    assert advice.mistake is mistake
    assert words in advice.sentence


def test_rows_that_do_not_correspond_are_named(tmp_path: Path) -> None:
    source = rows_apart(tmp_path, frames=2)
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
