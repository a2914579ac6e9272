"""Sources opened from their layouts, and what must hold of them."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.support import dataset_trees as trees
from tests.support.strategies import assert_same_pose
from vergence_proto.datasets import DatasetError, StereoSource, open_source
from vergence_proto.geometry import Pose, RectifiedRig

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


Change = Callable[[Path], object]


def opening(spec: str) -> str:
    """What reading all of a source says is wrong."""
    with pytest.raises(DatasetError) as caught:
        list(open_source(spec))
    return str(caught.value)


def cut(path: Path) -> None:
    """Drop the second half of a file."""
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
