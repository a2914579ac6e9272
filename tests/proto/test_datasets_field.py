"""Data sets of the field: frames, truth, masks, poses and rig, by numbers of the test's own."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support import dataset_trees as trees
from tests.support import field_trees as field
from tests.support.sources import assert_images, assert_poses, assert_truth, rig_of
from tests.support.strategies import assert_same_pose
from vergence.cli.sources import source_at
from vergence_proto.datasets import DATASETS, find_sources, open_source
from vergence_proto.geometry import RectifiedRig

ALL_TREES = {**trees.TREES, **field.TREES}


def _set_visible(mask: Any, expected: Any) -> None:
    assert mask is not None
    np.testing.assert_array_equal(mask, expected)


class TestSintel:
    @pytest.mark.parametrize("name", ["clean_left", "final_left"])
    def test_a_scene(self, name: str, tmp_path: Path) -> None:
        source = open_source(f"sintel:{field.sintel_scene(tmp_path, name)}")
        assert (source.name, source.fps, len(source), source.metric) == ("alley_1", 24, 3, True)
        assert rig_of(source) == RectifiedRig(24, 16, 30, 31, 12, 12, 8, 0.1)
        assert_poses(source, trees.some_poses(3))
        assert_images(source, 0, 1, 51)
        assert_truth(source, 2, field.sintel_disparity())
        _set_visible(source[0].visible, ~field.HIDDEN)

    def test_images_alone_have_neither_truth_nor_poses(self, tmp_path: Path) -> None:
        folder = field.sintel_scene(tmp_path)
        for kind in ("disparities", "camdata_left"):
            (tmp_path / "training" / kind).rename(tmp_path / kind)
        source = open_source(f"sintel:{folder}")
        assert not source.metric
        assert all(each.truth_px is None and each.frame.pose is None for each in source)

    def test_a_camera_that_zooms_has_no_metres(self, tmp_path: Path) -> None:
        folder = field.sintel_scene(tmp_path)
        camera = tmp_path / "training" / "camdata_left" / "alley_1" / "frame_0002.cam"
        data = bytearray(camera.read_bytes())
        data[4:12] = np.float64(40).tobytes()
        camera.write_bytes(data)
        assert not open_source(f"sintel:{folder}").metric


class TestSpring:
    def test_a_sequence(self, tmp_path: Path) -> None:
        source = open_source(f"spring:{field.spring_sequence(tmp_path)}")
        assert (source.name, len(source), source.metric) == ("0001", 3, True)
        assert rig_of(source) == RectifiedRig(24, 16, 30, 31, 12, 12, 8, 0.065)
        assert_poses(source, trees.some_poses(3))
        assert_images(source, 0, 1, 51)
        assert source[0].truth_px is None

    def test_truth_has_twice_the_resolution_and_counts_the_pixels_of_the_images(
        self, tmp_path: Path
    ) -> None:
        h5py: Any = pytest.importorskip("h5py")
        folder = field.spring_sequence(tmp_path, count=1)
        doubled = np.zeros((2 * trees.HEIGHT, 2 * trees.WIDTH), np.float32)
        doubled[::2, ::2] = trees.a_disparity()
        (folder / "disp1_left").mkdir()
        with h5py.File(folder / "disp1_left" / "disp1_left_0001.dsp5", "w") as file:
            file.create_dataset("disparity", data=doubled, compression="gzip")
        assert_truth(open_source(f"spring:{folder}"), 0, trees.a_disparity())

    def test_a_part_of_the_frames_has_the_poses_of_its_numbers(self, tmp_path: Path) -> None:
        folder = field.spring_sequence(tmp_path)
        (folder / "frame_left" / "frame_left_0001.png").unlink()
        assert_poses(open_source(f"spring:{folder}"), trees.some_poses(3)[1:])


class TestVirtualKitti:
    @pytest.mark.parametrize("archives", [False, True], ids=["merged", "archives side by side"])
    def test_a_scene(self, archives: bool, tmp_path: Path) -> None:
        folder = field.vkitti2_scene(tmp_path, archives=archives)
        source = open_source(f"vkitti2:{folder}")
        assert (source.name, len(source), source.metric) == ("Scene01_clone", 3, True)
        assert rig_of(source) == RectifiedRig(24, 16, 30, 31, 12, 12, 8, 0.532725)
        assert_poses(source, trees.some_poses(3))
        assert_images(source, 2, 2, 52)
        depth_m = field.vkitti2_depth_cm() / 100
        expected = (30 * 0.532725 / depth_m).astype(np.float32)
        expected[0, :5] = np.nan  # the sky
        assert_truth(source, 0, expected, atol=1e-5)


class TestKittiRaw:
    def test_a_drive(self, tmp_path: Path) -> None:
        source = open_source(f"kittiraw:{field.kittiraw_drive(tmp_path)}")
        assert (source.name, source.fps) == ("2011_09_26_drive_0001_sync", 10)
        rig = rig_of(source)
        assert (rig.fx, rig.cx_left, rig.cx_right, rig.cy) == (20, 11, 11.5, 7)
        assert rig.baseline_m == pytest.approx(0.54)  # (1.2 + 9.6) / 20
        assert source[1].frame.capture_ns == 1317042145_100_000_445
        assert_images(source, 1, 1, 51)

    def test_poses_face_where_the_car_drives(self, tmp_path: Path) -> None:
        source = open_source(f"kittiraw:{field.kittiraw_drive(tmp_path)}")
        for each, expected in zip(source, field.kittiraw_poses(), strict=True):
            assert each.frame.pose is not None
            # Mercator is the sphere's to second order: 2 m are 2 m within a micrometre.
            assert_same_pose(each.frame.pose.world_from_left, expected, 1e-5)

    def test_the_depth_benchmarks_truth(self, tmp_path: Path) -> None:
        source = open_source(f"kittiraw:{field.kittiraw_drive(tmp_path)}")
        depth_m = (field.vkitti2_depth_cm() // 2) / 256
        px_m = 20 * rig_of(source).baseline_m
        assert_truth(source, 0, (px_m / depth_m).astype(np.float32), atol=1e-3)

    def test_without_the_scanners_calibration_there_are_no_poses(self, tmp_path: Path) -> None:
        folder = field.kittiraw_drive(tmp_path)
        (folder.parent / "calib_imu_to_velo.txt").unlink()
        source = open_source(f"kittiraw:{folder}")
        assert source.metric
        assert all(each.frame.pose is None for each in source)


class TestDrivingStereo:
    def test_a_drive(self, tmp_path: Path) -> None:
        source = open_source(f"drivingstereo:{field.drivingstereo_drive(tmp_path)}")
        assert (source.name, len(source), source.metric) == (field.DRIVE, 3, True)
        assert source.fps == pytest.approx(10)
        rig = rig_of(source)
        assert (rig.fx, rig.fy, rig.cx_left, rig.cx_right, rig.cy) == (30, 31, 12, 12.5, 8)
        assert rig.baseline_m == pytest.approx(np.sqrt(0.54**2 + 0.03**2 + 0.04**2))
        assert source[0].frame.capture_ns == field.DRIVE_START_NS
        assert_images(source, 1, 1, 51)
        assert_truth(source, 1, trees.a_disparity(1))

    @pytest.mark.parametrize("size", ["half", "full"])
    def test_weather_images_of_all_drives_lie_in_one_folder(
        self, size: str, tmp_path: Path
    ) -> None:
        path = field.drivingstereo_weather(tmp_path, size)
        assert len(find_sources(f"drivingstereo:{tmp_path}")) == 2
        source = open_source(f"drivingstereo:{path}")
        assert (len(source), source.metric) == (1, False)  # no calibration here
        assert_truth(source, 0, trees.a_disparity(7))


class TestApollo:
    def test_a_recording(self, tmp_path: Path) -> None:
        source = open_source(f"apollo:{field.apollo_recording(tmp_path)}")
        assert (source.name, len(source), source.metric) == ("stereo_train_001", 3, False)
        assert rig_of(source) == RectifiedRig(24, 16, 30, 31, 12, 12, 8, 0.1)
        assert source[0].frame.capture_ns == field.APOLLO_START_NS
        assert_images(source, 2, 2, 52)
        assert_truth(source, 2, trees.a_disparity(2))
        _set_visible(source[0].truth_mask, ~field.HIDDEN)

    def test_another_scale_is_an_option(self, tmp_path: Path) -> None:
        source = open_source(
            f"apollo:{field.apollo_recording(tmp_path, steps_per_px=200)}?steps=200"
        )
        assert_truth(source, 0, trees.a_disparity(), atol=0.0026)  # rounded to 1/200


class TestIrs:
    def test_a_scene(self, tmp_path: Path) -> None:
        source = open_source(f"irs:{field.irs_scene(tmp_path)}")
        assert (source.name, len(source), source.metric) == ("ArchVizInterior03Data", 3, False)
        assert_images(source, 0, 8, 58)
        assert_images(source, 2, 10, 60)
        assert_truth(source, 2, trees.a_disparity(10))

    @pytest.mark.parametrize("compression", [0, 2, 3], ids=["none", "ZIPS", "ZIP"])
    def test_exr_compressions(self, compression: int, tmp_path: Path) -> None:
        folder = field.irs_scene(tmp_path)
        values = np.full((trees.HEIGHT, trees.WIDTH), 3.25, np.float32)  # so even that ZIP shrinks
        field.write_exr(folder / "d_8.exr", values, compression=compression, name="R")
        assert_truth(open_source(f"irs:{folder}"), 0, values)

    def test_its_own_images_have_its_own_camera(self, tmp_path: Path) -> None:
        for name in ("l_1.png", "r_1.png"):
            trees.write_image(tmp_path / name, trees.an_image(0, 960, 540))
        source = open_source(f"irs:{tmp_path}")
        assert rig_of(source) == RectifiedRig(960, 540, 480, 480, 480, 480, 270, 0.1)
        assert source.metric


class TestFlyingThings:
    def test_a_pair_whose_truth_is_negative(self, tmp_path: Path) -> None:
        source = open_source(f"flyingthings:{field.flyingthings_pair(tmp_path)}")
        assert source.is_single_pair
        assert not source.metric
        assert_images(source, 0, 12, 62)
        assert_truth(source, 0, trees.a_disparity(12))
        _set_visible(source[0].visible, ~field.HIDDEN)

    def test_positive_truth_stays(self, tmp_path: Path) -> None:
        path = field.flyingthings_pair(tmp_path)
        truth = path.parents[1] / "disparity" / "left" / "0000012.pfm"
        trees.write_pfm_by_hand(truth, trees.a_disparity(12))
        assert_truth(open_source(f"flyingthings:{path}"), 0, trees.a_disparity(12))


class TestBooster:
    def test_a_scene(self, tmp_path: Path) -> None:
        source = open_source(f"booster:{field.booster_scene(tmp_path)}")
        assert (source.name, len(source), source.metric) == ("Bathroom", 3, True)
        assert rig_of(source) == RectifiedRig(24, 16, 30, 31, 12, 12.5, 8, 0.08)
        assert_images(source, 1, 1, 51)
        assert_truth(source, 1, trees.a_disparity())
        _set_visible(source[1].visible, ~field.HIDDEN)


class TestInStereo2K:
    def test_a_pair(self, tmp_path: Path) -> None:
        source = open_source(f"instereo2k:{field.instereo2k_pair(tmp_path)}")
        assert source.is_single_pair
        assert not source.metric
        assert_images(source, 0, 1, 51)
        assert_truth(source, 0, trees.a_disparity(), atol=0.0051)  # rounded to 1/100


class TestMiddlebury2006:
    def test_a_half_size_scene(self, tmp_path: Path) -> None:
        source = open_source(f"middlebury2006:{field.middlebury2006_scene(tmp_path)}")
        assert (source.name, source.is_single_pair, source.metric) == ("Aloe", True, False)
        assert rig_of(source) == RectifiedRig(24, 16, 1870, 1870, 11.5, 146.5, 7.5, 0.16)
        assert_images(source, 0, 1, 51)
        assert_truth(source, 0, field.grey_disparity(2)[1])

    def test_the_truth_of_2005_lies_above_its_exposures(self, tmp_path: Path) -> None:
        scene = field.middlebury2006_scene(tmp_path)
        for name in ("view1.png", "view5.png"):
            (scene / "Illum1" / "Exp1").mkdir(parents=True, exist_ok=True)
            (scene / name).rename(scene / "Illum1" / "Exp1" / name)
        source = open_source(f"middlebury2006:{scene / 'Illum1' / 'Exp1'}")
        assert source.name == "Aloe_Illum1_Exp1"
        assert_truth(source, 0, field.grey_disparity(2)[1])

    @pytest.mark.parametrize(
        ("width", "height", "suffix", "scale"),
        [(450, 375, ".png", 4), (900, 750, ".png", 2), (434, 383, ".ppm", 8)],
        ids=["2003 quarter size", "2003 half size", "2001"],
    )
    def test_the_scale_follows_from_the_size(
        self, width: int, height: int, suffix: str, scale: int, tmp_path: Path
    ) -> None:
        for name in ("im2", "im6"):
            trees.write_image(tmp_path / f"{name}{suffix}", trees.an_image(1, width, height))
        stored = np.full((height, width), 40, np.uint8)
        trees.write_image(tmp_path / f"disp2{'.pgm' if suffix == '.ppm' else suffix}", stored)
        source = open_source(f"middlebury2006:{tmp_path}")
        assert_truth(source, 0, np.full((height, width), 40 / scale, np.float32))

    @pytest.mark.parametrize(
        ("left", "right", "truth", "scale"),
        [
            ("scene1.row3.col3.ppm", "scene1.row3.col4.ppm", "truedisp.row3.col3.pgm", 16),
            ("im0.pgm", "im1.pgm", "disp0.pgm", 8),
        ],
        ids=["tsukuba", "map"],
    )
    def test_the_scenes_of_2001_with_other_names(
        self, left: str, right: str, truth: str, scale: int, tmp_path: Path
    ) -> None:
        for seed, name in enumerate((left, right)):
            image = trees.an_image(seed, 60, 40)
            trees.write_image(tmp_path / name, image if name.endswith("ppm") else image[..., 0])
        trees.write_image(tmp_path / truth, np.full((40, 60), 80, np.uint8))
        assert find_sources(f"middlebury2006:{tmp_path}") == [f"middlebury2006:{tmp_path}"]
        source = open_source(f"middlebury2006:{tmp_path}")
        assert_truth(source, 0, np.full((40, 60), 80 / scale, np.float32))

    def test_full_size_has_metres(self, tmp_path: Path) -> None:
        folder = field.middlebury2006_scene(tmp_path)
        source = open_source(f"middlebury2006:{folder}?scale=1")
        assert source.metric
        # Z = f b / (d + dmin): a stored disparity of 30 is 300.
        assert rig_of(source).offset_of_zero_disparity_px == -270
        depth_m = rig_of(source).depth_from_disparity(np.array([[30.0 + 270]], np.float32))
        assert depth_m[0, 0] == pytest.approx(3740 * 0.16 / 300)


@pytest.fixture(scope="module")
def everything(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All data sets side by side, with what macOS adds."""
    root = tmp_path_factory.mktemp("everything")
    for kind, write in ALL_TREES.items():
        write(root / kind)
    for path in [each for each in root.rglob("*") if each.is_file()]:
        if path.relative_to(root).parts[0] in field.TREES:
            (path.parent / f"._{path.name}").write_bytes(b"\0\5\26\7")
            twin = root / "__MACOSX" / path.relative_to(root)
            twin.parent.mkdir(parents=True, exist_ok=True)
            (twin.parent / f"._{path.name}").write_bytes(b"\0\5\26\7")
    return root


@pytest.mark.parametrize("kind", DATASETS)
def test_a_kind_finds_its_own_tree_and_no_other(kind: str, everything: Path) -> None:
    found = [Path(spec.split(":", 1)[1]) for spec in find_sources(f"{kind}:{everything}")]
    takes = {path.relative_to(everything).parts[0] for path in found}
    assert takes == {kind}


def test_eth3d_is_known_by_its_folder_or_by_the_files_of_colmap(tmp_path: Path) -> None:
    scene = trees.eth3d_scene(tmp_path)
    moved = scene.rename(tmp_path / "playground_1l")
    assert find_sources(f"eth3d:{tmp_path}") == [f"eth3d:{moved}"]
    assert find_sources(f"middlebury:{tmp_path}") == []
    (moved / "cameras.txt").unlink()
    assert find_sources(f"eth3d:{tmp_path}") == []
    assert find_sources(f"middlebury:{tmp_path}") == [f"middlebury:{moved}"]
    back = moved.rename(scene)
    assert find_sources(f"eth3d:{tmp_path}") == [f"eth3d:{back}"]


@pytest.mark.parametrize("kind", field.TREES)
def test_what_macos_adds_is_no_data(kind: str, everything: Path) -> None:
    (spec,) = find_sources(f"{kind}:{everything}")
    assert all(each.frame.left.shape == (16, 24, 3) for each in open_source(spec))


@pytest.mark.parametrize("kind", field.TREES)
def test_what_windows_adds_to_text_is_no_data(kind: str, tmp_path: Path) -> None:
    plain = open_source(f"{kind}:{field.TREES[kind](tmp_path / 'plain')}")
    folder = field.TREES[kind](tmp_path / "windows")
    for path in (tmp_path / "windows").rglob("*"):
        if path.suffix in {".txt", ".xml"}:
            path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    windows = open_source(f"{kind}:{folder}")
    assert rig_of(windows) == rig_of(plain)
    for first, second in zip(plain, windows, strict=True):
        assert (first.frame.pose is None) == (second.frame.pose is None)
        if first.frame.pose is not None and second.frame.pose is not None:
            expected = first.frame.pose.world_from_left
            assert_same_pose(second.frame.pose.world_from_left, expected, 0)


# The file of one frame's truth: of the second frame, of a pair's only one.
TRUTH_OF_ONE = {
    "vergence": "frame_0001_gt.npz",
    "kitti2012": "disp_noc/*_10.png disp_occ/*_10.png",
    "kitti2015": "disp_noc_0/*_10.png disp_occ_0/*_10.png",
    "sceneflow": "disparity/TRAIN/A/0000/left/0007.pfm",
    "tartanair": "depth_left/000001_left_depth.npy",
    "middlebury": "disp0.pfm",
    "eth3d": "disp0GT.pfm",
    "sintel": "disparities/alley_1/frame_0002.png",
    "spring": "disp1_left_0002.dsp5",
    "vkitti2": "depth_00001.png",
    "drivingstereo": "train-disparity-map/*/*-602.png",
    "middlebury2006": "disp1.png",
    "kittiraw": "groundtruth/image_02/0000000001.png",
    "flyingthings": "disparity/*/*.pfm",
    "booster": "disp_00.npy",
    "instereo2k": "left_disp.png",
    "irs": "d_9.exr",
    "apollo": "disparity/*26454_Camera_5.png",
}
ONE_TRUTH_FOR_ALL_FRAMES = {"booster"}
NO_TRUTH = {"kitti", "euroc", "mcap"}


def test_no_kind_is_forgotten() -> None:
    assert {*TRUTH_OF_ONE, *NO_TRUTH} == set(DATASETS)


@pytest.mark.parametrize("kind", TRUTH_OF_ONE)
def test_a_frame_whose_truth_is_not_there_has_none(kind: str, tmp_path: Path) -> None:
    path = ALL_TREES[kind](tmp_path)
    if kind == "spring":  # its tree has no truth, which is HDF5
        for number in (1, 2, 3):
            truth = path / "disp1_left" / f"disp1_left_{number:04d}.dsp5"
            truth.parent.mkdir(exist_ok=True)
            truth.touch()
    spec = f"{kind}:{path}{'?fx=20' if kind == 'sceneflow' else ''}"
    before = open_source(spec)
    for pattern in TRUTH_OF_ONE[kind].split():
        (truth,) = tmp_path.rglob(pattern)
        truth.unlink()
    source = open_source(spec)
    assert all(each.read_truth is not None for each in before.files)
    known = [each.read_truth is not None for each in source.files]
    if kind in ONE_TRUTH_FOR_ALL_FRAMES or len(source) == 1:
        assert known == [False] * len(before)
    else:
        assert known == [True, False, True]
        assert "1 of 3 frames have no ground truth" in source.notes
    assert source[known.index(False)].truth_px is None


IMAGES_ALONE = {
    "sintel": "*_left/*/*.png *_right/*/*.png",
    "spring": "frame_left/* frame_right/*",
    "vkitti2": "rgb/*/*",
    "booster": "camera_0?/*",
    "instereo2k": "left.png right.png",
    "drivingstereo": "*-image/*/*",
    "middlebury2006": "view?.png",
    "kittiraw": "image_0?/data/*",
    "flyingthings": "image_clean/*/*",
    "irs": "l_*.png r_*.png",
    "apollo": "camera_?/*",
}


@pytest.mark.parametrize("kind", IMAGES_ALONE)
def test_images_alone_are_a_source_without_truth_poses_or_metres(kind: str, tmp_path: Path) -> None:
    path = field.TREES[kind](tmp_path)
    count = len(open_source(f"{kind}:{path}"))
    kept = {each for like in IMAGES_ALONE[kind].split() for each in tmp_path.rglob(like)}
    for file in tmp_path.rglob("*"):
        if file.is_file() and not (file in kept and "proj_depth" not in file.parts):
            file.unlink()
    source = open_source(f"{kind}:{path}")
    assert not source.metric
    assert len(list(source)) == count
    assert all(each.truth_px is None and each.frame.pose is None for each in source)
    assert rig_of(source) == RectifiedRig(24, 16, 24, 24, 11.5, 11.5, 7.5, 0.1)


@pytest.mark.parametrize("kind", DATASETS)
def test_vergence_run_takes_the_kind(kind: str, tmp_path: Path) -> None:
    path = ALL_TREES[kind](tmp_path)
    assert len(source_at(f"{kind}:{path}{'?fx=20' if kind == 'sceneflow' else ''}")) > 0
