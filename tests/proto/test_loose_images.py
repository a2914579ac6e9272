"""Images without a calibration, and folders whose kind of data set is found."""

from pathlib import Path

import pytest

from tests.support import dataset_trees as trees
from tests.support import field_trees
from vergence_proto.datasets import (
    DATASETS,
    DatasetError,
    detect_sources,
    open_image_folder,
    open_images,
    open_source,
)
from vergence_proto.geometry import RectifiedRig
from vergence_proto.types import StereoRig

OPTIONS = {"sceneflow": "?fx=20"}
TREES = {**trees.TREES, **field_trees.TREES}
SIZE = (trees.WIDTH, trees.HEIGHT)
RIG = StereoRig.from_rectified(RectifiedRig(*SIZE, 30, 30, 11.5, 11.5, 7.5, 0.2))


def unknown(size: tuple[int, int]) -> None:
    assert size == SIZE


def known(size: tuple[int, int]) -> StereoRig:
    assert size == SIZE
    return RIG


def write(path: Path, seed: int = 1) -> Path:
    trees.write_image(path, trees.an_image(seed))
    return path


@pytest.mark.parametrize("kind", DATASETS)
def test_the_kind_of_a_data_set_is_found(kind: str, tmp_path: Path) -> None:
    TREES[kind](tmp_path)
    (spec,) = detect_sources(tmp_path)
    assert spec.startswith(f"{kind}:")
    # Its own folder is enough too; of a lone pair, the path may be no folder.
    path = Path(spec.partition(":")[2])
    if path.is_dir():
        assert detect_sources(path) == [spec]
    open_source(spec + OPTIONS.get(kind, ""))


def test_images_without_a_data_set_are_none(tmp_path: Path) -> None:
    write(tmp_path / "left" / "0.png")
    write(tmp_path / "right" / "0.png")
    assert detect_sources(tmp_path) == []


def test_two_images_are_a_pair(tmp_path: Path) -> None:
    left, right = write(tmp_path / "a.png", 1), write(tmp_path / "b.png", 2)
    source = open_images(left, right, known)
    assert source.is_single_pair
    assert source.metric
    assert source.rig is RIG
    frame = source[0].frame
    assert (frame.left != frame.right).any()


def test_images_of_two_sizes_are_no_pair(tmp_path: Path) -> None:
    trees.write_image(tmp_path / "b.png", trees.an_image(1, 20, 10))
    with pytest.raises(DatasetError, match=r"b.png: expected 24x16 as a.png has, got 20x10"):
        open_images(write(tmp_path / "a.png"), tmp_path / "b.png", unknown)


def test_without_a_calibration_the_cameras_are_nominal(tmp_path: Path) -> None:
    source = open_images(write(tmp_path / "a.png"), write(tmp_path / "b.png"), unknown)
    assert not source.metric
    assert (source.rig.left.width, source.rig.left.height) == SIZE


def test_two_images_of_one_name_take_that_of_their_folder(tmp_path: Path) -> None:
    left, right = write(tmp_path / "left" / "0.png"), write(tmp_path / "right" / "0.png")
    assert open_images(left, right, unknown).name == "left"


@pytest.mark.parametrize("names", [("left", "right"), ("im0", "im1")], ids="-".join)
def test_a_folder_of_two_images_is_a_pair(names: tuple[str, str], tmp_path: Path) -> None:
    for seed, name in enumerate(names):
        write(tmp_path / f"{name}.png", seed)
    source = open_image_folder(tmp_path, unknown)
    assert source is not None
    assert source.is_single_pair


def test_two_folders_of_images_are_a_sequence_in_the_order_of_numbers(tmp_path: Path) -> None:
    for seed, number in enumerate((9, 10, 100)):
        write(tmp_path / "left" / f"{number}.png", seed)
        write(tmp_path / "right" / f"{number}.png", seed + 1)
    source = open_image_folder(tmp_path, known)
    assert source is not None
    assert [each.left.stem for each in source.files] == ["9", "10", "100"]
    assert [each.right.stem for each in source.files] == ["9", "10", "100"]
    assert len({frame.frame.capture_ns for frame in source}) == 3


def test_a_folder_without_images_is_nothing(tmp_path: Path) -> None:
    assert open_image_folder(tmp_path, unknown) is None


def test_sides_of_different_length_are_named(tmp_path: Path) -> None:
    write(tmp_path / "left" / "first.png")
    write(tmp_path / "left" / "second.png")
    write(tmp_path / "right" / "first.png")
    with pytest.raises(DatasetError, match="as many images in left as in right, got 2 and 1"):
        open_image_folder(tmp_path, unknown)


@pytest.mark.parametrize(
    ("lefts", "rights", "pairs"),
    [
        ("0 1 2", "0 1 2", "00 11 22"),
        ("0 1 2 3", "0 1 3", "00 11 22 33"),  # the right image 2 is missing, and named
        ("1 2 3", "0 1 3", "00 11 22 33"),
        ("10 20 30", "11 21 31", "10:11 20:21 30:31"),  # numbers of two clocks: in order
    ],
    ids=["alike", "one missing", "one missing on each side", "two clocks"],
)
def test_images_of_a_folder_belong_together_by_number(
    lefts: str, rights: str, pairs: str, tmp_path: Path
) -> None:
    for side, numbers in (("left", lefts), ("right", rights)):
        for number in numbers.split():
            write(tmp_path / side / f"cam_{number}.png", int(number))
    source = open_image_folder(tmp_path, unknown)
    assert source is not None
    found = [(each.left.stem[4:], each.right.stem[4:]) for each in source.files]
    assert found == [tuple(pair.split(":")) if ":" in pair else (*pair,) for pair in pairs.split()]
    missing = {path.name for path in source.missing_images}
    alone = {*lefts.split()} ^ {*rights.split()} if ":" not in pairs else set()
    assert missing == {f"cam_{number}.png" for number in alone}
