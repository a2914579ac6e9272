"""Data sets as people have them: from other systems, in parts, out of order, a little damaged."""

import codecs
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from tests.support import dataset_trees as trees
from tests.support import field_trees as field
from tests.support.sources import assert_poses, assert_truth, rig_of
from tests.support.strategies import assert_same_pose
from vergence_proto.datasets import (
    DatasetError,
    SourceFrame,
    StereoSource,
    find_sources,
    open_source,
    read_ahead,
)
from vergence_proto.geometry import Pose

TREES = {**trees.TREES, **field.TREES}
OPTIONS = {"sceneflow": "?fx=20"}
TEXT = {".txt", ".csv", ".yaml", ".json", ".xml"}
IMAGES = {".png", ".ppm"}
APPLE_DOUBLE = b"\0\5\26\7\0\2\0\0Mac OS X        "


def _opened(kind: str, path: Path) -> StereoSource:
    return open_source(f"{kind}:{path}{OPTIONS.get(kind, '')}")


def _assert_same(first: StereoSource, second: StereoSource) -> None:
    assert (second.fps, second.metric, second.notes) == (first.fps, first.metric, first.notes)
    assert second.rig.left == first.rig.left
    assert second.rig.right == first.rig.right
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(other.frame.left, one.frame.left)
        np.testing.assert_array_equal(other.frame.right, one.frame.right)
        assert other.frame.capture_ns == one.frame.capture_ns
        assert (other.frame.pose is None) == (one.frame.pose is None)
        if one.frame.pose is not None and other.frame.pose is not None:
            assert_same_pose(other.frame.pose.world_from_left, one.frame.pose.world_from_left, 0)
        assert (other.truth_px is None) == (one.truth_px is None)
        if one.truth_px is not None and other.truth_px is not None:
            np.testing.assert_array_equal(other.truth_px, one.truth_px)


def _companions(root: Path) -> None:
    """What macOS and Windows leave beside the files that they copy, and in archives."""
    for path in [each for each in root.rglob("*") if each.is_file()]:
        (path.parent / f"._{path.name}").write_bytes(APPLE_DOUBLE)
        (path.parent / ".DS_Store").write_bytes(b"\0\0\0\1Bud1")
        (path.parent / "Thumbs.db").write_bytes(b"\xd0\xcf\x11\xe0")
        (path.parent / "desktop.ini").write_bytes(b"[.ShellClassInfo]\r\n")
        twin = root / "__MACOSX" / path.relative_to(root)
        twin.parent.mkdir(parents=True, exist_ok=True)
        (twin.parent / f"._{path.name}").write_bytes(APPLE_DOUBLE)


def _rewritten(change: Callable[[str], bytes]) -> Callable[[Path], None]:
    def rewrite(root: Path) -> None:
        for path in root.rglob("*"):
            if path.suffix in TEXT:
                path.write_bytes(change(path.read_text("utf-8")))

    return rewrite


def _capitals(root: Path) -> None:
    """Some cameras and file systems write suffixes in capitals; truth keeps its own."""
    for path in list(root.rglob("*")):
        truth = any(
            word in str(path.relative_to(root))
            for word in ("disp", "depth", "mask", "occlusions", "outofframe", "specular")
        )
        if path.suffix in IMAGES and not truth:
            path.rename(path.with_suffix(path.suffix.upper()))


def _windows_text(text: str) -> bytes:
    return codecs.BOM_UTF8 + text.replace("\n", "\r\n").encode()


DISGUISES: dict[str, Callable[[Path], None]] = {
    "companions": _companions,
    "byte order mark and CR LF": _rewritten(_windows_text),
    "UTF-16": _rewritten(lambda text: text.encode("utf-16")),
    "UTF-16 without a mark": _rewritten(lambda text: text.encode("utf-16-le")),
    "no line end at the end": _rewritten(lambda text: text.rstrip("\n").encode()),
    "blank lines at the end": _rewritten(lambda text: f"{text}\n \t\n\n".encode()),
    "capital suffixes": _capitals,
}


@pytest.mark.parametrize("kind", TREES)
@pytest.mark.parametrize("disguise", DISGUISES)
def test_what_other_systems_add_changes_nothing(kind: str, disguise: str, tmp_path: Path) -> None:
    plain, dressed = tmp_path / "plain", tmp_path / "dressed"
    expected = _opened(kind, TREES[kind](plain))
    path = TREES[kind](dressed)
    DISGUISES[disguise](dressed)
    _assert_same(expected, _opened(kind, path))
    (spec,) = find_sources(f"{kind}:{dressed}")
    assert Path(spec.partition(":")[2].removesuffix("/mav0")) == path


@pytest.mark.parametrize("kind", ["kitti", "euroc", "vkitti2", "sintel"])
def test_links_to_folders_are_followed_and_may_lead_back(kind: str, tmp_path: Path) -> None:
    TREES[kind](tmp_path / "disk")
    linked = tmp_path / "data sets, räume"  # a blank, a comma and an umlaut in a name
    linked.mkdir()
    (linked / "here").symlink_to(tmp_path / "disk", target_is_directory=True)
    (tmp_path / "disk" / "back").symlink_to(linked, target_is_directory=True)
    (spec,) = find_sources(f"{kind}:{linked}")
    assert len(list(open_source(spec))) > 0


def test_a_folder_of_somebody_else_is_passed_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = trees.vergence_sequence(tmp_path)
    (tmp_path / "lost+found").mkdir()
    scan = os.scandir

    def refusing(path: Any) -> Any:  # the suite may run as root, which reads every folder
        if Path(path).name == "lost+found":
            raise PermissionError(13, "Permission denied")
        return scan(path)

    monkeypatch.setattr(os, "scandir", refusing)
    assert find_sources(f"vergence:{tmp_path}") == [f"vergence:{folder}"]


def _poses(root: Path) -> Path:
    (poses,) = [each for each in root.rglob("*.txt") if "pose" in str(each.relative_to(root))]
    return poses


def _kitti(root: Path, count: int) -> Path:
    return trees.kitti_sequence(root, cameras=(0, 1), count=count)  # poses are camera 0's


@pytest.mark.parametrize("kind", ["vergence", "kitti", "tartanair"])
def test_comments_between_poses_are_no_poses(kind: str, tmp_path: Path) -> None:
    path = _kitti(tmp_path, 3) if kind == "kitti" else TREES[kind](tmp_path)
    poses = _poses(tmp_path)
    lines = poses.read_text().splitlines()
    poses.write_text("\n".join(["# a heading", lines[0], "", "  # and one more", *lines[1:], ""]))
    assert_poses(_opened(kind, path), trees.some_poses(3))


def test_commas_may_separate_and_trail(tmp_path: Path) -> None:
    folder = trees.vergence_sequence(tmp_path)
    poses = folder / "poses.txt"
    poses.write_text(poses.read_text().replace(" ", ", ").replace("\n", ",\n"))
    calib = folder / "calib.json"
    calib.write_text(calib.read_text().replace("}", ", }"))
    assert_poses(open_source(f"vergence:{folder}"), trees.some_poses(3))


def test_text_of_an_old_editor_is_read(tmp_path: Path) -> None:
    folder = trees.kitti_sequence(tmp_path)
    calib = folder / "calib.txt"
    calib.write_bytes(b"Temperatur: 21 \xb0C\n" + calib.read_bytes())
    assert len(open_source(f"kitti:{folder}")) == 3


@pytest.mark.parametrize("kind", ["kitti", "vergence", "tartanair"])
class TestSomeFramesOfASequence:
    def _later(self, kind: str, root: Path, first: int, count: int) -> Path:
        """Keep only ``count`` images from ``first`` on; poses and times stay whole."""
        build = {
            "kitti": lambda: _kitti(root, 10),
            "vergence": lambda: trees.vergence_sequence(root, count=10),
            "tartanair": lambda: trees.tartanair_trajectory(root, 1, count=10),
        }
        folder = build[kind]()
        kept = range(first, first + count)
        for path in [*root.rglob("*.png"), *root.rglob("*.np?")]:
            digits = "".join(filter(str.isdigit, path.name))
            if int(digits) not in kept:
                path.unlink()
        return folder

    def test_each_has_the_pose_of_its_number(self, kind: str, tmp_path: Path) -> None:
        source = open_source(f"{kind}:{self._later(kind, tmp_path, 4, 3)}")
        assert_poses(source, trees.some_poses(10)[4:7])
        assert source.notes == ()

    def test_each_has_the_time_of_its_number(self, kind: str, tmp_path: Path) -> None:
        whole = open_source(f"{kind}:{self._later(kind, tmp_path / 'whole', 0, 10)}")
        part = open_source(f"{kind}:{self._later(kind, tmp_path / 'part', 4, 3)}")
        times_ns = [each.capture_ns for each in whole.files]
        assert [each.capture_ns for each in part.files] == times_ns[4:7]

    def test_as_many_poses_as_frames_belong_to_them_in_order(
        self, kind: str, tmp_path: Path
    ) -> None:
        folder = self._later(kind, tmp_path, 4, 3)
        poses = _poses(tmp_path)
        poses.write_text("\n".join(poses.read_text().splitlines()[4:7]))
        assert_poses(open_source(f"{kind}:{folder}"), trees.some_poses(10)[4:7])

    def test_frames_beyond_the_poses_have_none_and_a_note_says_so(
        self, kind: str, tmp_path: Path
    ) -> None:
        folder = self._later(kind, tmp_path, 0, 3)
        poses = _poses(tmp_path)
        poses.write_text("\n".join(poses.read_text().splitlines()[:2]))
        source = open_source(f"{kind}:{folder}")
        assert [each.frame.pose is None for each in source] == [False, False, True]
        assert source.notes == (f"{poses} has no pose for 1 of 3 frames, which start cold",)

    def test_a_pose_that_tracking_lost_is_none(self, kind: str, tmp_path: Path) -> None:
        folder = self._later(kind, tmp_path, 0, 3)
        poses = _poses(tmp_path)
        lines = poses.read_text().splitlines()
        lines[1] = " ".join(["nan"] * len(lines[1].split()))
        poses.write_text("\n".join(lines))
        source = open_source(f"{kind}:{folder}")
        assert [each.frame.pose is None for each in source] == [False, True, False]


def test_a_gap_in_the_numbers_is_noted(tmp_path: Path) -> None:
    folder = trees.vergence_sequence(tmp_path, count=5)
    for side in ("left", "right"):
        (folder / f"frame_0002_{side}.png").unlink()
    source = open_source(f"vergence:{folder}")
    assert_poses(source, [trees.some_poses(5)[k] for k in (0, 1, 3, 4)])
    assert source.notes == (f"{folder}: 1 frames between the first and the last are missing",)


class TestSceneFlow:
    @pytest.fixture
    def folder(self, tmp_path: Path) -> Path:
        """Of SceneFlow's own size, without camera_data, which is a download of its own."""
        folder = trees.sceneflow_sequence(tmp_path, count=1)
        for side in ("left", "right"):
            trees.write_image(folder / side / "0006.png", trees.an_image(1, 960, 540))
        (tmp_path / "camera_data/TRAIN/A/0000/camera_data.txt").unlink()
        truth = tmp_path / "disparity/TRAIN/A/0000/left/0006.pfm"
        trees.write_pfm_by_hand(truth, trees.a_disparity(0, 960, 540))
        return folder

    def test_disparity_needs_no_cameras(self, folder: Path) -> None:
        source = open_source(f"sceneflow:{folder}")
        assert (rig_of(source).fx, source.metric) == (1050, False)
        assert source[0].frame.pose is None
        assert_truth(source, 0, trees.a_disparity(0, 960, 540))

    def test_a_frame_without_truth_has_none_and_a_note_says_so(self, tmp_path: Path) -> None:
        folder = trees.sceneflow_sequence(tmp_path)
        (tmp_path / "disparity/TRAIN/A/0000/left/0007.pfm").unlink()
        source = open_source(f"sceneflow:{folder}?fx=20")
        assert [each.truth_px is None for each in source] == [False, True, False]
        assert source.notes == ("1 of 3 frames have no ground truth",)


@pytest.mark.parametrize("kind", ["sceneflow", "middlebury", "eth3d", "flyingthings", "irs"])
def test_truth_of_the_other_sign_is_the_same_truth(kind: str, tmp_path: Path) -> None:
    path = TREES[kind](tmp_path)
    expected = [each.truth_px for each in _opened(kind, path)]
    for file in tmp_path.rglob("*"):
        if file.suffix == ".pfm":
            values = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
            assert values is not None
            trees.write_pfm_by_hand(file, np.where(np.isfinite(values), -values, np.nan))
        elif file.suffix == ".exr":
            seed = int(file.stem[2:])
            field.write_exr(file, -np.nan_to_num(trees.a_disparity(seed)), compression=0)
    for each, truth_px in zip(_opened(kind, path), expected, strict=True):
        np.testing.assert_array_equal(each.truth_px, truth_px)


class TestEuroc:
    TRUTH = "mav0/state_groundtruth_estimate0/data.csv"

    @pytest.fixture
    def folder(self, tmp_path: Path) -> Path:
        return trees.euroc_recording(tmp_path)

    def _rows(self, path: Path, change: Callable[[list[str]], list[str]]) -> None:
        heading, *rows = path.read_text().splitlines()
        path.write_text("\n".join([heading, *change(rows)]))

    def _restamped(self, path: Path, change: Callable[[int], object]) -> None:
        def restamp(row: str) -> str:
            stamp, _, rest = row.partition(",")
            return f"{change(int(stamp))},{rest}"

        self._rows(path, lambda rows: [*map(restamp, rows)])

    @pytest.mark.parametrize("name", [TRUTH, "mav0/cam0/data.csv", "mav0/cam1/data.csv"])
    def test_rows_may_have_any_order_and_come_twice(self, name: str, folder: Path) -> None:
        expected = open_source(f"euroc:{folder}")
        self._rows(folder / name, lambda rows: [*rows[2:], *rows[:2], rows[0]])
        _assert_same(expected, open_source(f"euroc:{folder}"))

    @pytest.mark.parametrize("apart_ns", [1_000, -900_000, 24_000_000, -24_000_000])
    def test_stamps_less_than_half_a_frame_apart_are_a_pair(
        self, apart_ns: int, folder: Path
    ) -> None:
        expected = [each.frame.capture_ns for each in open_source(f"euroc:{folder}")]
        self._restamped(folder / "mav0/cam1/data.csv", lambda stamp: stamp + apart_ns)
        source = open_source(f"euroc:{folder}")
        assert [each.frame.capture_ns for each in source] == expected
        noted = [note for note in source.notes if "ms apart" in note]
        assert bool(noted) == (abs(apart_ns) > 1_000_000)

    def test_an_image_without_a_partner_is_left_out_and_noted(self, folder: Path) -> None:
        self._rows(folder / "mav0/cam1/data.csv", lambda rows: [rows[0], *rows[2:]])
        self._restamped(folder / "mav0/cam1/data.csv", lambda stamp: stamp + 20_000_000)
        source = open_source(f"euroc:{folder}")
        lefts = [each.left.stem for each in source.files]
        rights = [each.right.stem for each in source.files]
        assert lefts == rights  # 30 ms to the wrong neighbour, 20 ms to the right one
        assert len(source) == 3
        assert any("1 images have no partner" in note for note in source.notes)

    @pytest.mark.parametrize(
        "unit",
        [
            lambda ns: f"{ns // 10**9}.{ns % 10**9:09d}",
            lambda ns: ns // 10**3,
            lambda ns: ns // 10**6,
        ],
        ids=["seconds", "microseconds", "milliseconds"],
    )
    def test_stamps_of_another_unit_are_times(
        self, unit: Callable[[int], object], folder: Path
    ) -> None:
        expected = open_source(f"euroc:{folder}")
        for name in (self.TRUTH, "mav0/cam0/data.csv", "mav0/cam1/data.csv"):
            self._restamped(folder / name, unit)
        source = open_source(f"euroc:{folder}")
        assert source.fps == pytest.approx(20)
        for one, other in zip(expected, source, strict=True):
            assert abs(one.frame.capture_ns - other.frame.capture_ns) < 10**6
            assert (one.frame.pose is None) == (other.frame.pose is None)

    def test_a_trajectory_of_another_clock_is_noted(self, folder: Path) -> None:
        self._restamped(folder / self.TRUTH, lambda stamp: stamp - 3600 * 10**9)
        source = open_source(f"euroc:{folder}")
        assert all(each.frame.pose is None for each in source)
        (note,) = source.notes
        assert note.startswith(f"{folder / self.TRUTH}: no image has a pose")

    def test_without_lists_the_names_are_the_stamps(self, folder: Path) -> None:
        expected = open_source(f"euroc:{folder}")
        for camera in ("cam0", "cam1"):
            (folder / "mav0" / camera / "data.csv").unlink()
        _assert_same(expected, open_source(f"euroc:{folder}"))

    def test_a_calibration_may_have_nested_and_block_lists(self, folder: Path) -> None:
        expected = open_source(f"euroc:{folder}")
        for camera in ("cam0", "cam1"):
            path = folder / "mav0" / camera / "sensor.yaml"
            read = yaml.safe_load(path.read_text())
            read["T_BS"]["data"] = np.reshape(read["T_BS"]["data"], (4, 4)).tolist()
            nested = path.read_text().partition("T_BS:")[0] + yaml.safe_dump(read)
            path.write_text(nested.replace("- - ", "- -\t"))
        _assert_same(expected, open_source(f"euroc:{folder}"))

    def test_lost_poses_are_gaps(self, folder: Path) -> None:
        self._rows(
            folder / self.TRUTH,
            lambda rows: [*rows[:1], rows[1].split(",")[0] + ",nan" * 16, *rows[2:]],
        )
        source = open_source(f"euroc:{folder}")
        assert source[1].frame.pose is not None  # interpolated over 100 ms


async def _read(source: StereoSource) -> tuple[dict[int, SourceFrame], dict[int, str]]:
    unread: dict[int, str] = {}

    def note(index: int, error: DatasetError) -> None:
        unread[index] = str(error)

    return {k: frame async for k, frame in read_ahead(source, on_unreadable=note)}, unread


PARTS = {
    "vergence": ("frame_0001_right.png", "frame_0001_gt.npz"),
    "kitti": ("image_3/000001.png", None),
    "euroc": (f"mav0/cam1/data/{trees.EUROC_START_NS + trees.EUROC_STEP_NS}.png", None),
    "tartanair": ("image_right/000001_right.png", "depth_left/000001_left_depth.npy"),
    "sceneflow": ("right/0007.png", "../../../../disparity/TRAIN/A/0000/left/0007.pfm"),
}


@pytest.mark.parametrize("kind", PARTS)
@pytest.mark.parametrize("damage", ["missing", "cut short"])
async def test_one_image_that_cannot_be_read_costs_its_own_frame(
    kind: str, damage: str, tmp_path: Path
) -> None:
    folder = TREES[kind](tmp_path)
    image = folder / PARTS[kind][0]
    image.unlink() if damage == "missing" else image.write_bytes(image.read_bytes()[:60])
    source = _opened(kind, folder)
    frames, unread = await _read(source)
    assert [*frames] == [0, *range(2, len(source))]
    assert [*unread] == [1]
    assert unread[1].startswith(f"{image}: ")


@pytest.mark.parametrize("kind", ["vergence", "tartanair", "sceneflow"])
async def test_damaged_truth_costs_no_frame(kind: str, tmp_path: Path) -> None:
    folder = TREES[kind](tmp_path)
    truth = folder / str(PARTS[kind][1])
    truth.write_bytes(truth.read_bytes()[:60])
    frames, unread = await _read(_opened(kind, folder))
    assert [each.truth_px is None for each in frames.values()] == [False, True, False]
    assert [*unread] == [1]


@pytest.mark.parametrize("kind", ["kitti", "tartanair", "kittiraw", "irs"])
def test_a_damaged_first_image_leaves_the_others(kind: str, tmp_path: Path) -> None:
    folder = TREES[kind](tmp_path)
    source = _opened(kind, folder)
    source.files[0].left.write_bytes(b"")
    again = _opened(kind, folder)
    np.testing.assert_array_equal(again[1].frame.left, source[1].frame.left)


def test_a_turned_pose_matrix_is_reported(tmp_path: Path) -> None:
    folder = trees.vergence_sequence(tmp_path)
    turned = Pose(np.eye(3), np.array([0.3, 0.0, 0.5])).matrix.T
    lines = [trees.words(turned)] * 3
    (folder / "poses.txt").write_text("\n".join(lines))
    with pytest.raises(DatasetError, match=r"poses\.txt, line 1: expected 0 0 0 1 as the last row"):
        open_source(f"vergence:{folder}")
