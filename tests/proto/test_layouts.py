"""Every reader gives what its layout says, checked by formulas of the test's own."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.proto import trees
from tests.proto.strategies import assert_same_pose
from vergence_proto.geometry import Pose, RectifiedRig
from vergence_proto.layouts import LAYOUTS, StereoSource, find_sources, open_source
from vergence_proto.types import Distortion

TEXT_PRECISION = 1e-9  # poses were written with twelve digits


def rig_of(source: StereoSource) -> RectifiedRig:
    rig = source.rig.as_rectified()
    assert rig is not None
    return rig


def assert_poses(source: StereoSource, expected: list[Pose]) -> None:
    assert len(source) == len(expected)
    for each, world_from_left in zip(source, expected, strict=True):
        assert each.frame.pose is not None
        assert_same_pose(each.frame.pose.world_from_left, world_from_left, TEXT_PRECISION)


def assert_truth(
    source: StereoSource, index: int, expected: NDArray[np.float32], atol: float = 0
) -> None:
    truth_px = source[index].truth_px
    assert truth_px is not None
    assert truth_px.dtype == np.float32
    np.testing.assert_allclose(truth_px, expected, rtol=0, atol=atol)


def assert_images(source: StereoSource, index: int, left: int, right: int) -> None:
    frame = source[index].frame
    np.testing.assert_array_equal(frame.left, trees.an_image(left))
    np.testing.assert_array_equal(frame.right, trees.an_image(right))


OPTIONS = {"sceneflow": "?fx=20"}


def test_every_layout_has_a_tree_here() -> None:
    assert set(trees.TREES) == set(LAYOUTS)


@pytest.mark.parametrize("kind", trees.TREES)
def test_what_is_found_under_a_folder_opens(kind: str, tmp_path: Path) -> None:
    trees.TREES[kind](tmp_path)
    (spec,) = find_sources(f"{kind}:{tmp_path}{OPTIONS.get(kind, '')}")
    source = open_source(spec)
    frames = list(source)
    assert [each.frame.frame_id for each in frames] == list(range(1, len(source) + 1))
    captures_ns = [each.frame.capture_ns for each in frames]
    assert captures_ns == sorted(set(captures_ns))
    for each in frames:
        assert each.frame.left.shape == each.frame.right.shape == (trees.HEIGHT, trees.WIDTH, 3)
    assert source[-1].frame.frame_id == len(source)
    with pytest.raises(IndexError):
        source[len(source)]


class TestVergence:
    def test_a_sequence(self, tmp_path: Path) -> None:
        source = open_source(f"vergence:{trees.vergence_sequence(tmp_path)}")
        assert (source.name, source.fps, source.metric) == ("room", 25, True)
        expected = RectifiedRig(trees.WIDTH, trees.HEIGHT, 20, 21, 11.5, 11.5, 7.5, 0.1)
        assert rig_of(source) == expected
        assert_poses(source, trees.some_poses(3))
        assert_images(source, 1, 2, 3)
        assert [each.frame.capture_ns for each in source] == [0, 40_000_000, 80_000_000]
        disparity_px = trees.a_disparity(1)
        assert_truth(source, 1, disparity_px)
        np.testing.assert_array_equal(source[1].truth_mask, disparity_px < 8)
        np.testing.assert_array_equal(source[1].visible, disparity_px > 3)

    def test_poses_and_truth_are_optional(self, tmp_path: Path) -> None:
        folder = trees.vergence_sequence(tmp_path)
        (folder / "poses.txt").unlink()
        (folder / "frame_0001_gt.npz").unlink()
        source = open_source(f"vergence:{folder}")
        assert source[1].frame.pose is None
        assert source[1].truth_px is None
        assert source[1].truth_mask is None
        assert_truth(source, 2, trees.a_disparity(2))

    def test_a_sparse_reference_lands_on_the_nearest_pixel(self, tmp_path: Path) -> None:
        folder = trees.vergence_sequence(tmp_path)
        (folder / "frame_0000_gt.npz").unlink()
        u, v, disp = [3.4, 7.6, 99.0], [2.0, 4.4, 1.0], [5.5, 6.5, 7.5]
        np.savez(folder / "frame_0000_ref.npz", u=u, v=v, disp=disp)
        expected = np.full((trees.HEIGHT, trees.WIDTH), np.nan, np.float32)
        expected[2, 3], expected[4, 8] = 5.5, 6.5  # the third lies outside
        assert_truth(open_source(f"vergence:{folder}"), 0, expected)

    @pytest.mark.parametrize("extension", [".png", ".webp"])
    def test_a_pair_is_a_source_of_length_one(self, extension: str, tmp_path: Path) -> None:
        trees.write_image(tmp_path / f"left{extension}", trees.an_image(0))
        trees.write_image(tmp_path / f"right{extension}", trees.an_image(1))
        np.savez(tmp_path / "gt.npz", disp=trees.a_disparity())
        calib = '{"fx": 20, "cx": 11, "cy": 7, "cx_right": 13, "baseline_m": 0.2,'
        trees.write_lines(tmp_path / "calib.json", f'{calib} "width": 24, "height": 16}}')
        source = open_source(f"vergence:{tmp_path}")
        assert (len(source), source.fps) == (1, None)
        assert rig_of(source) == RectifiedRig(24, 16, 20, 20, 11, 13, 7, 0.2)
        assert_images(source, 0, 0, 1)
        assert_truth(source, 0, trees.a_disparity())
        assert source[0].truth_mask is not None
        assert source[0].truth_mask.all()

    def test_an_unknown_calibration_is_nominal_and_says_so(self, tmp_path: Path) -> None:
        folder = trees.vergence_sequence(tmp_path)
        calib = '{"fx": null, "fy": null, "cx": null, "cy": null, "baseline_m": null,'
        trees.write_lines(folder / "calib.json", f'{calib} "width": 24, "height": 16}}')
        source = open_source(f"vergence:{folder}")
        assert not source.metric
        assert rig_of(source) == RectifiedRig(24, 16, 24, 24, 11.5, 11.5, 7.5, 0.1)


class TestKitti:
    def test_grey_cameras(self, tmp_path: Path) -> None:
        source = open_source(f"kitti:{trees.kitti_sequence(tmp_path, cameras=(0, 1))}")
        rig = rig_of(source)
        assert (rig.fx, rig.cx_left, rig.cx_right, rig.cy) == (20, 11, 11, 7)
        assert rig.baseline_m == pytest.approx(0.54)
        assert_poses(source, trees.some_poses(3))
        assert_images(source, 2, 2, 12)
        assert source.fps == 10
        assert source[2].frame.capture_ns == 200_000_000
        assert source[2].truth_px is None

    def test_a_colour_camera_stands_beside_the_grey_one_whose_poses_are_given(
        self, tmp_path: Path
    ) -> None:
        source = open_source(f"kitti:{trees.kitti_sequence(tmp_path)}")
        assert rig_of(source).baseline_m == pytest.approx(0.06 + 0.47)
        assert_images(source, 1, 21, 31)
        for each, world_from_cam0 in zip(source, trees.some_poses(3), strict=True):
            assert each.frame.pose is not None
            # t2 = K^-1 P2[:, 3] = 0.06 m: the colour camera stands 6 cm left of the grey one.
            here_in_world = world_from_cam0.rotation @ [-0.06, 0, 0] + world_from_cam0.translation_m
            actual = each.frame.pose.world_from_left
            np.testing.assert_allclose(actual.translation_m, here_in_world, atol=TEXT_PRECISION)
            np.testing.assert_allclose(
                actual.rotation, world_from_cam0.rotation, atol=TEXT_PRECISION
            )

    def test_sequences_after_ten_have_no_poses(self, tmp_path: Path) -> None:
        folder = trees.kitti_sequence(tmp_path)
        (tmp_path / "poses" / "00.txt").unlink()
        assert open_source(f"kitti:{folder}")[0].frame.pose is None

    @pytest.mark.parametrize("year", [2012, 2015])
    def test_stereo_pairs(self, year: int, tmp_path: Path) -> None:
        source = open_source(f"kitti{year}:{trees.kitti_pair(tmp_path, year)}")
        assert (source.name, len(source)) == ("000046", 1)
        rig = rig_of(source)
        assert (rig.fx, rig.cx_left, rig.cx_right) == (20, 11, 11.5)
        assert rig.baseline_m == pytest.approx((1.2 + 9.6) / 20)
        assert_images(source, 0, 1, 2)
        assert_truth(source, 0, trees.a_disparity())
        np.testing.assert_array_equal(source[0].visible, trees.a_disparity() <= 5)


class TestSceneFlow:
    def test_a_sequence(self, tmp_path: Path) -> None:
        source = open_source(f"sceneflow:{trees.sceneflow_sequence(tmp_path)}?fx=20")
        rig = rig_of(source)
        assert (rig.fx, rig.cx_left, rig.cy) == (20, 11.5, 7.5)
        assert rig.baseline_m == pytest.approx(0.065)
        assert_poses(source, trees.some_poses(3))
        assert_images(source, 0, 6, 94)
        assert_truth(source, 0, trees.a_disparity(6))
        assert source.metric

    @pytest.mark.parametrize(
        ("lens", "fx"), [("35mm_focallength", 1050), ("15mm_focallength", 450)]
    )
    def test_its_own_images_have_its_own_focal_length(
        self, lens: str, fx: int, tmp_path: Path
    ) -> None:
        rest = Path(lens) / "scene_forwards" / "fast"
        folder = tmp_path / "frames_cleanpass" / rest
        trees.write_image(folder / "left" / "0001.webp", trees.an_image(0, 960, 540))
        trees.write_image(folder / "right" / "0001.webp", trees.an_image(1, 960, 540))
        moved = np.eye(4)
        moved[0, 3] = 1
        lines = ["Frame 1", f"L {trees.words(np.eye(4))}", f"R {trees.words(moved)}"]
        trees.write_lines(tmp_path / "camera_data" / rest / "camera_data.txt", *lines)
        source = open_source(f"sceneflow:{folder}")
        assert rig_of(source) == RectifiedRig(960, 540, fx, fx, 479.5, 479.5, 269.5, 1)
        assert not source.metric  # Blender's units
        assert source[0].truth_px is None

    def test_a_frame_that_the_camera_data_leaves_out_has_no_pose(self, tmp_path: Path) -> None:
        folder = trees.sceneflow_sequence(tmp_path)
        cameras = tmp_path / "camera_data" / "TRAIN" / "A" / "0000" / "camera_data.txt"
        cameras.write_text("Frame 6" + cameras.read_text().split("Frame 6")[1].split("Frame 7")[0])
        source = open_source(f"sceneflow:{folder}?fx=20")
        assert [each.frame.pose is None for each in source] == [False, True, True]

    def test_intrinsics_beside_the_camera_data_need_no_option(self, tmp_path: Path) -> None:
        folder = trees.sceneflow_sequence(tmp_path)
        beside = tmp_path / "camera_data" / "TRAIN" / "A" / "0000" / "intrinsics.json"
        beside.write_text('{"fx": 21.5, "fps": 20}')
        source = open_source(f"sceneflow:{folder}")
        assert (rig_of(source).fx, source.fps, source.metric) == (21.5, 20, True)
        assert source[1].frame.capture_ns - source[0].frame.capture_ns == 50_000_000
        assert rig_of(open_source(f"sceneflow:{folder}?fx=20")).fx == 20  # whoever asks, gets it

    def test_mirrors_are_not_judged_where_the_data_tells_of_them(self, tmp_path: Path) -> None:
        folder = trees.sceneflow_sequence(tmp_path)
        specular = np.zeros((trees.HEIGHT, trees.WIDTH), np.uint8)
        specular[3:5, 7:9] = 255
        rest = Path("TRAIN") / "A" / "0000" / "left" / "0006.png"
        trees.write_image(tmp_path / "specular" / rest, specular)
        first, second, _ = open_source(f"sceneflow:{folder}?fx=20")
        assert first.truth_mask is not None
        np.testing.assert_array_equal(first.truth_mask, specular == 0)
        assert second.truth_mask is not None
        assert second.truth_mask.all()


class TestTartanAir:
    @pytest.mark.parametrize("version", [1, 2])
    def test_a_trajectory(self, version: int, tmp_path: Path) -> None:
        source = open_source(f"tartanair:{trees.tartanair_trajectory(tmp_path, version)}")
        assert rig_of(source) == RectifiedRig(24, 16, 320, 320, 12, 12, 8, 0.25)
        assert_poses(source, trees.some_poses(3))
        assert_images(source, 2, 2, 52)
        assert_truth(source, 2, trees.a_disparity(2), atol=1e-5)  # through depth in float32


class TestEuroc:
    def test_the_rig_is_the_raw_one(self, tmp_path: Path) -> None:
        source = open_source(f"euroc:{trees.euroc_recording(tmp_path)}")
        assert source.name == "MH_01_easy"
        assert source.fps == pytest.approx(20)
        left = source.rig.left
        assert (left.fx, left.fy, left.cx, left.cy) == (20.5, 20.6, 11.7, 7.4)
        assert left.distortion is Distortion.BROWN_CONRADY
        assert left.coefficients == (-0.28, 0.07, 0.0002, 1.7e-05)
        assert source.rig.as_rectified() is None
        np.testing.assert_allclose(
            source.rig.left_from_right.translation_m, [0.11, 0, 0], atol=1e-8
        )

    def test_poses_are_interpolated_to_the_images(self, tmp_path: Path) -> None:
        source = open_source(f"euroc:{trees.euroc_recording(tmp_path)}/mav0")
        assert source[0].frame.pose is None  # before the ground truth begins
        bodies = trees.some_poses(4)
        for k in (1, 2, 3):
            pose = source[k].frame.pose
            assert pose is not None
            a, b = bodies[k - 1], bodies[k]
            middle_xyzw = trees.xyzw_of(a.rotation) + trees.xyzw_of(b.rotation)
            world_from_body = Pose.from_xyzw(middle_xyzw, (a.translation_m + b.translation_m) / 2)
            expected = world_from_body.matrix @ trees.EUROC_LEFT_IN_BODY.matrix
            np.testing.assert_allclose(pose.world_from_left.matrix, expected, atol=1e-8)

    def test_times_keep_every_nanosecond(self, tmp_path: Path) -> None:
        source = open_source(f"euroc:{trees.euroc_recording(tmp_path)}")
        assert source[0].frame.capture_ns == trees.EUROC_START_NS

    def test_an_image_that_only_one_camera_took_is_left_out(self, tmp_path: Path) -> None:
        folder = trees.euroc_recording(tmp_path)
        listing = folder / "mav0" / "cam1" / "data.csv"
        lines = listing.read_text().splitlines()
        listing.write_text("\n".join(lines[:2] + lines[3:]))
        assert len(open_source(f"euroc:{folder}")) == 3

    def test_nothing_is_made_up_inside_a_hole(self, tmp_path: Path) -> None:
        folder = trees.euroc_recording(tmp_path)
        truth = folder / "mav0" / "state_groundtruth_estimate0" / "data.csv"
        lines = truth.read_text().splitlines()
        truth.write_text("\n".join([lines[0], lines[1], lines[4]]))  # 150 ms apart
        assert all(each.frame.pose is None for each in open_source(f"euroc:{folder}"))

    def test_a_fisheye_recording_without_truth(self, tmp_path: Path) -> None:
        folder = trees.euroc_recording(tmp_path)
        for camera in ("cam0", "cam1"):
            sensor = folder / "mav0" / camera / "sensor.yaml"
            sensor.write_text(sensor.read_text().replace("radial-tangential", "equidistant"))
        truth = folder / "mav0" / "state_groundtruth_estimate0"
        (truth / "data.csv").unlink()
        truth.rmdir()
        source = open_source(f"euroc:{folder}")
        assert source.rig.left.distortion is Distortion.KANNALA_BRANDT
        assert source[0].frame.pose is None


class TestMiddlebury:
    @pytest.mark.parametrize("truth", ["disp0.pfm", "disp0GT.pfm"])
    def test_a_scene(self, truth: str, tmp_path: Path) -> None:
        source = open_source(f"middlebury:{trees.middlebury_scene(tmp_path, truth)}")
        rig = rig_of(source)
        assert (rig.fx, rig.cx_left, rig.cx_right, rig.cy) == (20.5, 11.25, 13.75, 7.5)
        assert_truth(source, 0, trees.a_disparity())
        # Middlebury's own formula, in millimetres, with the offset d as its files state it.
        depth_m = 193.001 * 20.5 / (trees.a_disparity() + 2.5) / 1000
        disparity_px = trees.a_disparity() - np.float32(rig.offset_of_zero_disparity_px)
        np.testing.assert_allclose(rig.depth_from_disparity(disparity_px), depth_m, rtol=1e-5)

    def test_eth3d_keeps_its_truth_beside(self, tmp_path: Path) -> None:
        source = open_source(f"eth3d:{trees.eth3d_scene(tmp_path)}")
        assert_truth(source, 0, trees.a_disparity())
        np.testing.assert_array_equal(source[0].visible, ~(trees.a_disparity() > 5))

    def test_a_scene_without_truth_is_a_source_too(self, tmp_path: Path) -> None:
        folder = trees.middlebury_scene(tmp_path)
        (folder / "disp0.pfm").unlink()
        assert open_source(f"middlebury:{folder}")[0].truth_px is None
