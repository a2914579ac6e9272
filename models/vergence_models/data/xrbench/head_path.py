"""The path of the head through a room."""

from __future__ import annotations

import numpy as np

from vergence_models.data.trajectories import HeadMotion
from vergence_models.data.xrbench.meshes import Matrix
from vergence_models.data.xrbench.recipe import Recipe
from vergence_models.data.xrbench.things import Room

# The generator's calm head, slowed down so that it stays within the clearance around its start.
_SWAY = 0.6


class HeadPath:
    """The pose of the left camera at any time, also before the first frame and after the last."""

    def __init__(self, recipe: Recipe, room: Room) -> None:
        # Drawn for the seed alone: the same path, at whatever speed it is walked.
        rng = np.random.default_rng([recipe.seed, 77])
        self._motion = HeadMotion.draw(rng, speed=_SWAY)
        self._start = room.world_from_start
        self._speed = recipe.speed
        self._fps = recipe.fps

    def frame_time_s(self, frame: int) -> float:
        """Mid-exposure of a frame."""
        return frame / self._fps

    def world_from_left(self, time_s: float) -> Matrix:
        """Pose [4, 4], OpenCV camera axes."""
        return self._start @ self._motion.start_from_camera(time_s * self._speed)


def right_of(world_from_left: Matrix, baseline_m: float) -> Matrix:
    """world_from_right [4, 4] of the same moment."""
    left_from_right = np.eye(4)
    left_from_right[0, 3] = baseline_m
    return world_from_left @ left_from_right
