"""Helpers of all scenes: the viewpoint, places in view, floating objects, light.

The camera stands over the world's origin and looks along z; the surroundings are turned about it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vergence_models.data.materials import MaterialPalette
from vergence_models.data.scenes import Builder, PointLight, Scene, look_along
from vergence_models.data.shapes import Cutout, Shape


@dataclass(frozen=True, slots=True)
class Viewpoint:
    """The properties of the camera that a scene is built for."""

    half_angle: float  # radians from the axis to the left and right, head motion included
    aspect: float  # height / width
    nearest_m: float  # the smallest distance of any object
    baseline_m: float

    @property
    def scale(self) -> float:
        """Furniture grows with the nearest distance, so that wide baselines see rooms too."""
        return max(1.0, self.nearest_m / 1.2)


def float_about(
    b: Builder, palette: MaterialPalette, rng: np.random.Generator, view: Viewpoint, count: int, *,
    far_m: float, up_m: float, moving: float, large: bool = False,
) -> None:  # fmt: skip
    """Add floating objects in view, some of them moving and spinning."""
    for _ in range(count):
        near = view.nearest_m
        # Uniform in disparity, so that all disparities occur alike.
        z = 1 / rng.uniform(1 / max(far_m, near * 1.5), 1 / near)
        x, y = rng.uniform(-1, 1, 2) * z * np.tan(min(view.half_angle, 1.2)) * (1, view.aspect)
        size = z * float(np.exp(rng.uniform(np.log(0.03), np.log(0.4 if large else 0.2))))
        half = size * np.exp(rng.normal(0, 0.5, 3))
        if rng.random() < 0.2:
            half[:2] = size * rng.uniform(0.03, 0.12)  # a stick
        half = np.minimum(half, 0.6 * z)
        z += float(half.max())
        shape = Shape(int(rng.choice([0, 1, 1, 2, 2, 3])))
        cutout = Cutout(int(rng.choice([0, 0, 1, 2, 3, 4]))) if shape is Shape.QUAD else Cutout.FULL
        travels = rng.random() < moving
        frame = b.moving(rng.normal(0, 0.6, 3) * z) if travels else b
        frame.add(
            shape, (x, y - up_m, z), half, palette.any(2 * float(half.max())),
            rotation=look_along(rng.normal(0, 1, 3)), cutout=cutout,
            taper=float(rng.uniform(-0.7, 0.7)) if shape is Shape.CYLINDER else 0.0,
            spin_rad_s=rng.normal(0, 1.5, 3) if travels else (0, 0, 0),
        )  # fmt: skip


def spot(rng: np.random.Generator, view: Viewpoint, *, far_m: float) -> tuple[float, float]:
    """A place on the floor in view, near ones as likely as far ones."""
    distance = view.nearest_m * (far_m / view.nearest_m) ** rng.uniform(0.1, 1)
    angle = rng.uniform(-1, 1) * min(view.half_angle * 1.1, 1.4)
    return float(distance * np.sin(angle)), float(distance * np.cos(angle))


def light_color(rng: np.random.Generator, strength: float) -> NDArray[np.float64]:
    warm = rng.normal(0, 0.12)
    return np.array([1 + warm, 1.0, 1 - warm]) * strength * rng.uniform(0.5, 1.5)


def compose(
    b: Builder, rng: np.random.Generator, palette: MaterialPalette,
    lights: tuple[PointLight, PointLight], target: NDArray[np.float64], half_angle: float, *,
    sky: bool = False,
) -> Scene:  # fmt: skip
    return Scene(
        primitives=np.array(b.rows, np.float32),
        lights=lights,
        shadow_target_m=target,
        shadow_half_angle_rad=half_angle,
        ambient=np.clip(1 + rng.normal(0, 0.08, 3), 0.7, 1.3) * rng.uniform(0.25, 0.9),
        sky_texture=palette.texture("photo", "clouds"),
        sky_color=np.array([0.9, 1.0, 1.15]) * (rng.uniform(0.8, 2.2) if sky else 0.8),
        exposure=float(rng.uniform(0.15, 0.6)),
    )
