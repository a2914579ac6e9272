"""Outdoor scenes: streets under the sky, and swarms of objects before a far background."""

from __future__ import annotations

import numpy as np

from vergence_models.data import furniture
from vergence_models.data.materials import MaterialPalette
from vergence_models.data.scenes import Builder, PointLight, Scene, look_along, turn_y
from vergence_models.data.shapes import Shape
from vergence_models.data.surroundings import Viewpoint, compose, float_about, light_color, spot


def street(
    rng: np.random.Generator, palette: MaterialPalette, view: Viewpoint
) -> tuple[Scene, float]:
    """A road or a square between facades, under the sky, and the height of the camera."""
    s = max(1.0, view.nearest_m / 4)
    camera_height = rng.uniform(1.2, 3.0) * s
    b = Builder(turn_y(float(rng.normal(0, 0.3))))
    ground = palette.textured(3 * s, "photo", "clouds", "stones", "bricks", "speckle")
    b.floor((0, 0, 0), 400 * s, 400 * s, ground)
    road = palette.textured(2 * s, "speckle", "clouds")
    half_road = rng.uniform(3, 7) * s
    b.floor((0, -0.01, 0), half_road, 300 * s, road)
    for dash in range(12):
        b.floor((0, -0.02, dash * 6 * s), 0.08 * s, 1.5 * s, palette.plain(tone=0.9))
    for side in (-1, 1):
        z = -5 * s
        while z < 90 * s:
            w, h = rng.uniform(4, 14) * s, rng.uniform(2, 9) * s
            x = side * (half_road + rng.uniform(2, 10) * s)
            if rng.random() < 0.75:
                deep = 4 * s
                look = palette.textured(5 * s, "photo", "bricks", "tiles", "clouds", "stones")
                b.box((x + side * deep, -h, z + w / 2), (deep, h, w / 2), look)
                for row in range(int(rng.integers(0, 3))):
                    for column in range(int(rng.integers(1, 4))):
                        at = (x - side * 0.05, -(1.5 + 3 * row) * s, z + (column + 0.5) * w / 4)
                        b.box(at, (0.08 * s, 0.7 * s, 0.5 * s), palette.polished(mirror=0.5))
            z += w + rng.uniform(0, 8) * s
    if rng.random() < 0.7:  # hills or a skyline along the horizon
        far = rng.uniform(80, 350) * s
        for turn in np.linspace(-1.2, 1.2, 7):
            horizon = b.at(0, 0, 0, yaw=float(turn)).at(0, 0, far)
            h = far * rng.uniform(0.02, 0.2)
            horizon.wall((0, -h, 0), far * 0.25, h, palette.textured(far * 0.3, "photo", "clouds"))
    for _ in range(int(rng.integers(5, 18))):
        x, z = spot(rng, view, far_m=60 * s)
        if np.hypot(x, z) < view.nearest_m + 1.5 * s:
            continue
        make = furniture.OUTDOOR[rng.integers(len(furniture.OUTDOOR))]
        rolls = rng.random() < 0.2
        velocity = np.array([0, 0, rng.normal(0, 5)]) if rolls else np.zeros(3)
        place = Builder(turn_y(float(rng.normal(0, 0.2))), np.array([x, 0, z]), velocity, b.rows)
        make(place, palette, rng, s * rng.uniform(0.9, 1.3))
    float_about(Builder(rows=b.rows), palette, rng, view, int(rng.choice([0, 0, 4])), far_m=20 * s,
           up_m=camera_height, moving=0.3)  # fmt: skip
    sun = np.array([rng.normal(0, 60), -rng.uniform(40, 120), rng.uniform(-40, 60)]) * s
    lights = (
        PointLight(sun, light_color(rng, 1.6), 1000 * s),
        PointLight(np.array([0, -30.0 * s, 0]), light_color(rng, 0.3), 1000 * s),
    )
    target = np.array([0, 0, 15.0 * s])
    scene = compose(b, rng, palette, lights, target, 0.35, sky=True)
    return scene, float(camera_height)


def swarm(
    rng: np.random.Generator, palette: MaterialPalette, view: Viewpoint
) -> tuple[Scene, float]:
    """Many textured things afloat before a textured far background; the camera is at height 0."""
    far = view.nearest_m * float(np.exp(rng.uniform(np.log(4), np.log(40))))
    b = Builder()
    span = far * np.tan(min(view.half_angle, 1.2)) * 2.5
    tilt = look_along(np.array([rng.normal(0, 0.3), rng.normal(0, 0.2), 1.0]))
    b.add(Shape.QUAD, (0, 0, far), (span, span, 1.0), palette.textured(span * 0.5), rotation=tilt)
    if rng.random() < 0.5:
        b.floor((0, far * rng.uniform(0.1, 0.4), 0), span, span * 2, palette.textured(far * 0.4))
    count = int(rng.integers(8, 36))
    float_about(b, palette, rng, view, count, far_m=far, up_m=0.0, moving=0.6, large=True)
    lamp = np.array([rng.normal(0, 0.4), -0.8, -0.2]) * far
    lights = (
        PointLight(lamp, light_color(rng, 1.5), 3 * far),
        PointLight(rng.normal(0, 0.5, 3) * far, light_color(rng, 0.6), 2 * far),
    )
    target = np.array([0, 0, far * 0.6])
    return compose(b, rng, palette, lights, target, 0.8, sky=True), 0.0
