"""The contents of scenes: surfaces, things with parts in a frame of their own, lamps, a sky."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike

from vergence_models.data.trajectories import rotation
from vergence_models.data.xrbench import meshes
from vergence_models.data.xrbench.meshes import Matrix, Mesh

RGB = tuple[float, float, float]


class Finish(Enum):
    MATTE = "matte"
    SATIN = "satin"  # varnish, ceramics, plastics: a soft highlight over the colour
    METAL = "metal"
    MIRROR = "mirror"
    GLASS = "glass"  # a thin pane or shell


# What shows its surroundings instead of itself: no camera can measure its depth.
SPECULAR = frozenset({Finish.MIRROR, Finish.GLASS})


@dataclass(frozen=True, slots=True)
class Surface:
    """A finish over a plain colour, or over a pattern that repeats every `span_m`."""

    finish: Finish = Finish.MATTE
    color: RGB = (0.6, 0.6, 0.6)  # linear reflectance
    roughness: float = 0.2
    pattern: str | None = None  # a kind of vergence_models.data.patterns
    pattern_seed: int = 0
    span_m: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Thing:
    """One labelled object. Its frame stands on the floor, its front towards -z."""

    name: str
    parts: tuple[tuple[Surface, Mesh], ...]  # one for each surface, in the thing's frame
    world_from_thing: Matrix  # [4, 4] at time zero
    velocity_m_s: Matrix = field(default_factory=lambda: np.zeros(3))  # world axes
    spin_rad_s: Matrix = field(default_factory=lambda: np.zeros(3))  # the thing's axes

    @property
    def moves(self) -> bool:
        return bool(np.any(self.velocity_m_s) or np.any(self.spin_rad_s))

    def pose(self, time_s: float) -> Matrix:
        """world_from_thing [4, 4] at a time."""
        then = self.world_from_thing.copy()
        then[:3, :3] = then[:3, :3] @ rotation(self.spin_rad_s * time_s)
        then[:3, 3] += self.velocity_m_s * time_s
        return then

    def bounds_m(self) -> tuple[Matrix, Matrix]:
        """The lowest and the highest corner [3] of its box, in its own frame."""
        points = np.concatenate([mesh.points for _, mesh in self.parts])
        return points.min(0), points.max(0)


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """A rectangle that shines along -z of its frame; a thing like any other, without parts."""

    name: str
    world_from_panel: Matrix  # [4, 4]
    half_m: tuple[float, float]
    radiance: RGB


@dataclass(frozen=True, slots=True, eq=False)
class Room:
    """A scene: everything that can be seen, and where a head may be in it."""

    things: tuple[Thing, ...]
    lamps: tuple[Panel, ...]
    sky_seed: int
    sky_radiance: float
    world_from_start: Matrix  # [4, 4]: where the head is at time zero, OpenCV camera axes


class Workbench:
    """Collects the parts of one thing."""

    def __init__(self) -> None:
        self._parts: dict[Surface, list[Mesh]] = {}

    def add(self, surface: Surface, mesh: Mesh, at: ArrayLike = (0, 0, 0), *, yaw: float = 0.0,
            turn: Matrix | None = None) -> None:  # fmt: skip
        """Add a mesh, turned about the vertical (or by a rotation) and then moved."""
        frame = placed(*np.asarray(at, float), yaw=yaw)
        if turn is not None:
            frame[:3, :3] = turn
        self._parts.setdefault(surface, []).append(mesh.moved(frame))

    def box(self, surface: Surface, at: ArrayLike, half_m: ArrayLike, *, yaw: float = 0.0) -> None:
        self.add(surface, meshes.box(half_m), at, yaw=yaw)

    def rods(self, surface: Surface, radius_m: float, *ends: tuple[ArrayLike, ArrayLike]) -> None:
        for start, end in ends:
            self.add(surface, meshes.rod(start, end, radius_m))

    def legs(self, surface: Surface, half_x: float, half_z: float, height: float,
             thick: float) -> None:  # fmt: skip
        """Four square legs that reach from the floor to a height."""
        for x in (-half_x, half_x):
            for z in (-half_z, half_z):
                self.box(surface, (x, -height / 2, z), (thick, height / 2, thick))

    def parts(self) -> tuple[tuple[Surface, Mesh], ...]:
        return tuple(
            (surface, meshes.joined(group).wound()) for surface, group in self._parts.items()
        )

    def take(self, other: Workbench, at: Sequence[float], *, yaw: float = 0.0) -> None:
        """Put what was made on another bench on this one."""
        for surface, mesh in other.parts():
            self.add(surface, mesh, at, yaw=yaw)


def placed(x: float, y: float, z: float, *, yaw: float = 0.0) -> Matrix:
    """A frame [4, 4] at a point, turned about the vertical."""
    frame = np.eye(4)
    frame[:3, :3] = rotation(np.array([0.0, yaw, 0.0]))
    frame[:3, 3] = (x, y, z)
    return frame
