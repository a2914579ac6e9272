"""The methods of evaluation and studies: each turns footage into disparity.

A method has a name, and may see changed footage, for example with noisy camera motion.
"""

from __future__ import annotations

import itertools
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from vergence_models.data.trajectories import rotation
from vergence_models.evaluation.stepping import Footage, Prediction, SteppedNetwork
from vergence_proto.geometry import Pose


@dataclass(frozen=True, slots=True, eq=False)
class Method:
    """Predicts a sequence frame by frame; the label is unique among those compared."""

    label: str
    predict: Callable[[Footage], Iterator[Prediction]]

    def with_input(self, what: str, change: Callable[[Footage], Footage]) -> Method:
        """The same method, shown changed footage."""
        return Method(f"{self.label}, {what}", lambda footage: self.predict(change(footage)))


def counted(iterations: int) -> str:
    return f"{iterations} iteration{'s' if iterations > 1 else ''}"


def counted_start(network: SteppedNetwork, iterations: int) -> str:
    refined = ", the last ones at 2x" if network.refines_at_2x(iterations) else ""
    return counted(iterations) + refined


def warm_method(network: SteppedNetwork, name: str, iterations: int, *, cold: int) -> Method:
    """Carries its state; ``cold`` iterations on the first frame."""
    return Method(
        f"{name}, warm, {counted(iterations)}",
        lambda footage: network.sequence(footage, cold=cold, warm=iterations),
    )


def single_frame_method(network: SteppedNetwork, name: str, iterations: int) -> Method:
    """Forgets its state after every frame."""
    return Method(
        f"{name}, every frame cold, {counted_start(network, iterations)}",
        lambda footage: network.sequence(footage, cold=iterations, warm=None),
    )


def without_poses(footage: Footage) -> Footage:
    """Footage without camera motion: the network's state keeps its place."""
    return replace(footage, views=[replace(v, world_from_left=None) for v in footage.views])


def with_pose_noise(footage: Footage, *, deg: float, m: float) -> Footage:
    """Footage whose motion from each frame to the next is off by exactly this much.

    The axis and the direction of each error are random, and the same for every size of the error.
    Footage without poses stays as it is.
    """
    poses = [view.world_from_left for view in footage.views]
    if not (deg or m) or any(pose is None for pose in poses):
        return footage
    known = [pose for pose in poses if pose is not None]
    random = np.random.default_rng(zlib.crc32(footage.name.encode()))
    noisy = known[:1]
    for before, now in itertools.pairwise(known):
        axis, direction = (v / np.linalg.norm(v) for v in random.standard_normal((2, 3)))
        curr_from_true = Pose(rotation(axis * np.radians(deg)), direction * m)
        prev_from_curr = before.inverse() @ now
        noisy.append(noisy[-1] @ prev_from_curr @ curr_from_true.inverse())
    views = [
        replace(view, world_from_left=pose) for view, pose in zip(footage.views, noisy, strict=True)
    ]
    return replace(footage, views=views)
