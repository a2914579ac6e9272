"""Data sets of real cameras give what they say, checked by formulas of the test's own."""

from pathlib import Path

import numpy as np
import pytest

from tests.support import dataset_trees as trees
from tests.support.sources import TEXT_PRECISION, assert_images, assert_poses, assert_truth, rig_of
from vergence_proto.datasets import open_source
from vergence_proto.geometry import Pose
from vergence_proto.types import Distortion


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
