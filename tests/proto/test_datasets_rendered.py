"""Rendered data sets hold what they state, checked with formulas of the test's own."""

from pathlib import Path

import numpy as np
import pytest

from tests.support import dataset_trees as trees
from tests.support.sources import assert_images, assert_poses, assert_truth, rig_of
from vergence_proto.datasets import open_source
from vergence_proto.geometry import RectifiedRig


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
        assert rig_of(open_source(f"sceneflow:{folder}?fx=20")).fx == 20  # the asked one

    def test_mirrors_are_not_judged_where_the_data_names_them(self, tmp_path: Path) -> None:
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
