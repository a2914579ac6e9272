"""A scene is a list of primitives with materials, two lights and a sky; builders assemble it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vergence_models.data.materials import Material
from vergence_models.data.shapes import Cutout, Shape

# Columns of `Scene.primitives`. World axes: x right, y DOWN, z forward; the floor is y = 0.
SHAPE = 0
CENTER_M = slice(1, 4)
ROTATION = slice(4, 13)  # world_from_local, row-major
HALF_M = slice(13, 16)  # half the size along each local axis
TAPER = 16
CUTOUT = 17
VELOCITY_M_S = slice(18, 21)
SPIN_RAD_S = slice(21, 24)
MATERIAL = slice(24, 38)
COLUMNS = 38


@dataclass(frozen=True, slots=True, eq=False)
class PointLight:
    position_m: NDArray[np.float64]  # [3], world
    color: NDArray[np.float64]  # [3], irradiance at `reach_m`
    reach_m: float  # irradiance falls to half of its maximum at this distance


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    primitives: NDArray[np.float32]  # [P, COLUMNS]
    lights: tuple[PointLight, PointLight]  # the first one casts shadows
    shadow_target_m: NDArray[np.float64]  # [3]: where the first light's shadow map looks
    shadow_half_angle_rad: float
    ambient: NDArray[np.float64]  # [3]
    sky_texture: int
    sky_color: NDArray[np.float64]  # [3]
    exposure: float  # the mean brightness that the camera aims at, 0..1


@dataclass(slots=True, eq=False)
class Builder:
    """Adds primitives in a local frame; frames nest, and all share one list of rows."""

    rotation: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))  # world_from_frame
    origin_m: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    velocity_m_s: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    rows: list[list[float]] = field(default_factory=list)

    def at(self, x: float, y: float, z: float, *, yaw: float = 0.0) -> Builder:
        """A frame at a point of this one, turned about the vertical."""
        origin = self.rotation @ (x, y, z) + self.origin_m
        return Builder(self.rotation @ turn_y(yaw), origin, self.velocity_m_s, self.rows)

    def moving(self, velocity_m_s: ArrayLike) -> Builder:
        """The same frame, for things that travel."""
        return Builder(self.rotation, self.origin_m, np.asarray(velocity_m_s, float), self.rows)

    def add(
        self,
        shape: Shape,
        center_m: ArrayLike,
        half_m: ArrayLike,
        material: Material,
        *,
        rotation: NDArray[np.float64] | None = None,
        taper: float = 0.0,
        cutout: Cutout = Cutout.FULL,
        spin_rad_s: ArrayLike = (0.0, 0.0, 0.0),
    ) -> None:
        """Add one primitive; `half_m` is half its size along its own axes."""
        center = self.rotation @ np.asarray(center_m, float) + self.origin_m
        turned = self.rotation if rotation is None else self.rotation @ rotation
        half = np.maximum(np.asarray(half_m, float), 1e-4)
        self.rows.append(
            [
                *(shape, *center, *turned.ravel(), *half, taper, cutout, *self.velocity_m_s),
                *np.asarray(spin_rad_s, float),
                *material.row(),
            ]
        )

    def box(self, center_m: ArrayLike, half_m: ArrayLike, material: Material) -> None:
        self.add(Shape.BOX, center_m, half_m, material)

    def ball(self, center_m: ArrayLike, half_m: ArrayLike, material: Material) -> None:
        self.add(Shape.ELLIPSOID, center_m, half_m, material)

    def post(
        self, center_m: ArrayLike, radius_m: float, half_height_m: float, material: Material,
        *, taper: float = 0.0,
    ) -> None:  # fmt: skip
        """An upright cylinder; taper > 0 is wider at the top."""
        half = (radius_m, radius_m, half_height_m)
        self.add(Shape.CYLINDER, center_m, half, material, rotation=_Z_UP, taper=taper)

    def rod(
        self, start_m: ArrayLike, end_m: ArrayLike, radius_m: float, material: Material
    ) -> None:
        """A cylinder between two points."""
        start, end = np.asarray(start_m, float), np.asarray(end_m, float)
        half = (radius_m, radius_m, float(np.linalg.norm(end - start)) / 2)
        aim = look_along(end - start)
        self.add(Shape.CYLINDER, (start + end) / 2, half, material, rotation=aim)

    def floor(self, center_m: ArrayLike, half_x: float, half_z: float, material: Material) -> None:
        """A horizontal quad."""
        self.add(Shape.QUAD, center_m, (half_x, half_z, 1.0), material, rotation=_Z_UP)

    def wall(
        self, center_m: ArrayLike, half_width: float, half_height: float, material: Material,
        *, yaw: float = 0.0, cutout: Cutout = Cutout.FULL,
    ) -> None:  # fmt: skip
        """An upright quad that faces along z of the frame, turned by yaw."""
        half = (half_width, half_height, 1.0)
        turned = turn_y(yaw)
        self.add(Shape.QUAD, center_m, half, material, rotation=turned, cutout=cutout)


def turn_y(yaw: float) -> NDArray[np.float64]:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def look_along(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """A rotation [3, 3] whose z axis points along a direction."""
    z = direction / np.linalg.norm(direction)
    side = np.array([0.0, 1.0, 0.0]) if abs(z[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
    x = np.cross(side, z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


# Local z points up (world -y) and local y runs along world z.
_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
