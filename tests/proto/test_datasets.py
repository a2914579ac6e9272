"""Whatever the layout, what is found opens; and what the project's own layout says."""

from pathlib import Path

import numpy as np
import pytest

from tests.support import dataset_trees as trees
from tests.support import field_trees
from tests.support.sources import assert_images, assert_poses, assert_truth, rig_of
from vergence_proto.datasets import DATASETS, find_sources, open_source
from vergence_proto.geometry import RectifiedRig

TREES = {**trees.TREES, **field_trees.TREES}
OPTIONS = {"sceneflow": "?fx=20"}


def test_every_layout_has_a_tree_here() -> None:
    assert set(TREES) == set(DATASETS)


@pytest.mark.parametrize("kind", TREES)
def test_what_is_found_under_a_folder_opens(kind: str, tmp_path: Path) -> None:
    TREES[kind](tmp_path)
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
