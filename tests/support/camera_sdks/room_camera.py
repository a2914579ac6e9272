"""What the stand-ins of the camera SDKs film: the bundled sample, pair after pair."""

from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from vergence_proto.datasets import open_source

_ROOM = open_source(f"vergence:{files('vergence') / 'sample' / 'room'}")
RIG = _ROOM.rig.as_rectified()
assert RIG is not None


def pair(index: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """RGB, [H, W, 3]."""
    frame = _ROOM[index].frame
    return frame.left, frame.right


def world_from_left(index: int) -> NDArray[np.float64]:
    """[4, 4], OpenCV axes."""
    pose = _ROOM[index].frame.pose
    assert pose is not None
    return pose.world_from_left.matrix


def grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    mean: NDArray[np.uint8] = image.mean(axis=2).round().astype(np.uint8)
    return mean
