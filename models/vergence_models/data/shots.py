"""Draws shots: a camera, a motion, and a room, a street or a swarm of things in front of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vergence_models.data.indoors import clutter, room
from vergence_models.data.materials import MaterialPalette
from vergence_models.data.outdoors import street, swarm
from vergence_models.data.scenes import Scene
from vergence_models.data.surroundings import Viewpoint
from vergence_models.data.trajectories import HeadMotion, rotation
from vergence_models.data.views import Shot


@dataclass(frozen=True, slots=True)
class Mix:
    """Shares of the kinds of scene; the rest are rooms."""

    streets: float = 0.13
    swarms: float = 0.18
    clutter: float = 0.2


@dataclass(frozen=True, slots=True)
class Playback:
    """A calm head's motion, played back faster: one scene, one path and one last view.

    Only the past differs between clips of different speeds, so the effect of speed is separate
    from the content of the view.
    """

    speed: float = 1.0
    until_s: float = 8.0  # when the path ends; a clip must fit into it


def draw_shot(
    rng: np.random.Generator, kinds: tuple[str, ...], *, width: int, height: int, frames: int,
    rate_hz: float, mix: Mix | None = None, playback: Playback | None = None,
) -> Shot:  # fmt: skip
    """Draw everything about one clip. `kinds` names the textures of the bank that renders it.

    The camera's speed is random too, unless `playback` sets it; moving objects keep their own.
    """
    mix = mix or Mix()
    palette = MaterialPalette(rng, kinds)
    half_angle = np.radians(rng.uniform(50, 110)) / 2
    focal_px = width / 2 / np.tan(half_angle)
    low, high = (0.04, 0.2) if rng.random() < 0.8 else (0.2, 0.5)
    baseline_m = _log_uniform(rng, low, high)
    times_s = np.arange(frames) / rate_hz
    if playback is None:
        speed = 0.0 if rng.random() < 0.06 else _log_uniform(rng, 0.3, 20)
        motion = HeadMotion.draw(rng, speed=speed)
        start_from_left = reach = _poses(motion, times_s)
    else:
        motion = HeadMotion.draw(rng, speed=1.0)
        played_s = playback.until_s - (times_s[-1] - times_s) * playback.speed
        start_from_left = _poses(motion, played_s)
        reach = _poses(motion, np.arange(0, playback.until_s, 1 / rate_hz))
    travel_m = float(np.linalg.norm(reach[:, :3, 3], axis=1).max())
    turn = np.arccos(np.clip(reach[:, 2, 2], -1, 1)).max()

    largest_px = width * _log_uniform(rng, 0.06, 0.26)
    world_from_start = np.eye(4)
    world_from_start[:3, :3] = rotation(rng.normal(0, [0.12, 0.0, 0.06]))
    view = Viewpoint(
        half_angle=float(half_angle + 0.5 * turn),
        aspect=height / width,
        nearest_m=max(focal_px * baseline_m / largest_px, 0.3) + travel_m,
        baseline_m=baseline_m,
    )
    draw = rng.random()
    scene: Scene
    if draw < mix.streets:
        scene, camera_height_m = street(rng, palette, view)
    elif draw < mix.streets + mix.swarms:
        scene, camera_height_m = swarm(rng, palette, view)
    elif draw < mix.streets + mix.swarms + mix.clutter:
        scene, camera_height_m = clutter(rng, palette, view)
    else:
        scene, camera_height_m = room(rng, palette, view)
    world_from_start[1, 3] = -camera_height_m
    return Shot(
        scene=scene,
        world_from_left=world_from_start @ start_from_left,
        times_s=times_s,
        focal_px=float(focal_px),
        cx=(width - 1) / 2 + float(rng.normal(0, 0.01)) * width,
        cy=(height - 1) / 2 + float(rng.normal(0, 0.01)) * height,
        baseline_m=float(baseline_m),
    )


def _poses(motion: HeadMotion, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """start_from_left [T, 4, 4]."""
    return np.stack([motion.start_from_camera(t) for t in times_s])


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
