"""Where shots take place: rooms, streets, and swarms of things before a far background.

The camera stands over the world's origin and looks along z; the surroundings are turned about it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vergence_models.data import furniture
from vergence_models.data.materials import Palette
from vergence_models.data.scenes import Builder, Light, Scene, look_along, turn_y
from vergence_models.data.shapes import Cutout, Shape


@dataclass(frozen=True, slots=True)
class Viewpoint:
    """What a setting needs to know of the camera."""

    half_angle: float  # radians from the axis to the left and right, head motion included
    aspect: float  # height / width
    nearest_m: float  # nothing may come nearer
    baseline_m: float

    @property
    def scale(self) -> float:
        """Furniture grows with the nearest distance, so that wide baselines see rooms too."""
        return max(1.0, self.nearest_m / 1.2)


def room(rng: np.random.Generator, palette: Palette, view: Viewpoint) -> tuple[Scene, float]:
    """A furnished room, and the height of the camera over its floor."""
    s = view.scale
    half = rng.uniform([1.6, 1.6], [4.5, 5.0]) * s  # x and z
    height = rng.uniform(2.2, 3.6) * s
    camera_height = rng.uniform(0.35, 0.7) * height
    yaw = float(rng.choice([0, np.pi / 2, np.pi]) + rng.normal(0, 0.35))
    stand = _stand(rng, half, yaw, margin=0.35 * s)
    # The room turns about the camera, which stays over the world's origin.
    world_from_room = turn_y(-yaw)
    offset = -world_from_room @ np.array([stand[0], 0, stand[1]])
    b = Builder(world_from_room, offset)
    _shell(b, palette, rng, half, height, s)

    def inside(x: float, z: float, radius: float) -> bool:
        local = world_from_room.T @ (np.array([x, 0, z]) - offset)
        return bool(abs(local[0]) < half[0] - radius and abs(local[2]) < half[1] - radius)

    placed = 0
    wanted = int(rng.integers(3, 14))
    for _ in range(wanted * 4):
        x, z = _spot(rng, view, far_m=float(half.max()) * 1.8)
        radius = 0.6 * s
        if inside(x, z, 0.4 * s) and np.hypot(x, z) > view.nearest_m + radius:
            turned = -yaw + float(rng.choice([0, np.pi / 2, np.pi, -np.pi / 2]))
            turned += float(rng.normal(0, 0.3)) if rng.random() < 0.5 else 0.0
            make = furniture.INDOOR[rng.integers(len(furniture.INDOOR))]
            spot = Builder(turn_y(turned), np.array([x, 0.0, z]), rows=b.rows)
            make(spot, palette, rng, s)
            placed += 1
        if placed >= wanted:
            break
    floating = int(rng.choice([0, 0, 2, 5]))
    _float(
        Builder(rows=b.rows), palette, rng, view, floating,
        far_m=float(half.min()), up_m=camera_height, moving=0.3,
    )  # fmt: skip
    lamp = world_from_room @ (rng.uniform(-0.5, 0.5, 3) * (2 * half[0], 0, 2 * half[1])) + offset
    lamp[1] = -height + 0.15 * s
    b_lamp = Builder(rows=b.rows)
    if rng.random() < 0.5:
        b_lamp.ball(lamp, (0.12 * s,) * 3, palette.lamp())
        b_lamp.rod(lamp, (lamp[0], -height, lamp[2]), 0.008 * s, palette.plain())
    center = world_from_room @ np.zeros(3) + offset
    lights = (
        Light(lamp + np.array([0, 0.05 * s, 0]), _light_color(rng, 1.6), 3 * s),
        Light(center + rng.normal(0, 1.5 * s, 3) * (1, 0, 1) - (0, height * 0.6, 0),
              _light_color(rng, 0.6), 3 * s),
    )  # fmt: skip
    target = lamp + np.array([0.01, 1.0, 0.02])
    reach = float(half.max())
    scene = _scene(b, rng, palette, lights, target, np.radians(68), frame_m=reach)
    return scene, float(camera_height)


def _stand(
    rng: np.random.Generator, half: NDArray[np.float64], yaw: float, *, margin: float
) -> NDArray[np.float64]:
    """A place in the room (its x and z) from which there is much to see."""
    forward = np.array([np.sin(yaw), np.cos(yaw)])
    places = rng.uniform(-1, 1, (6, 2)) * np.maximum(half - margin, 0.1)
    with np.errstate(divide="ignore"):
        ahead = np.min((half - places * np.sign(forward)) / np.abs(forward), axis=1)
    return np.asarray(places[np.argmax(ahead)])


def _shell(
    b: Builder, palette: Palette, rng: np.random.Generator, half: NDArray[np.float64],
    height: float, s: float,
) -> None:  # fmt: skip
    x, z = half
    ground = palette.textured(1.5 * s, "wood", "tiles", "photo", "stones", "clouds")
    b.floor((0, 0, 0), x, z, ground)
    ceiling = palette.plain() if rng.random() < 0.75 else palette.textured(1.5 * s)
    b.floor((0, -height, 0), x, z, ceiling)
    shared = palette.plain() if rng.random() < 0.45 else palette.textured(1.5 * s)
    skirting = palette.plain() if rng.random() < 0.5 else palette.wood(s)
    has_skirting = rng.random() < 0.6
    for side in range(4):
        width, away = (x, z) if side % 2 == 0 else (z, x)
        yaw = side * np.pi / 2
        wall = b.at(0, 0, 0, yaw=yaw).at(0, 0, away)  # faces -z, into the room
        own = shared if rng.random() < 0.7 else palette.any(1.5 * s)
        wall.wall((0, -height / 2, 0), width, height / 2, own)
        if has_skirting:
            wall.box((0, -0.06 * s, -0.01 * s), (width, 0.06 * s, 0.015 * s), skirting)
        _hang(wall, palette, rng, width, height, s)


def _hang(
    wall: Builder, palette: Palette, rng: np.random.Generator, width: float, height: float, s: float
) -> None:
    """Pictures, windows, doors, shelves, mirrors and curtains on a wall."""
    for _ in range(int(rng.integers(0, 5))):
        x = rng.uniform(-0.85, 0.85) * width
        kind = rng.random()
        w, h = rng.uniform(0.15, 0.6, 2) * s
        y = -height * rng.uniform(0.45, 0.7)
        frame = palette.wood(s) if rng.random() < 0.5 else palette.plain()
        if kind < 0.4:
            wall.box((x, y, -0.015 * s), (w + 0.04 * s, h + 0.04 * s, 0.015 * s), frame)
            picture = palette.textured(2 * max(w, h), "photo", "patchwork")
            wall.wall((x, y, -0.032 * s), w, h, picture)
        elif kind < 0.55:
            bright = palette.lamp()
            wall.wall((x, y, -0.005 * s), w, 0.6 * s, bright)
            wall.wall((x, y, -0.02 * s), w, 0.6 * s, frame, cutout=Cutout.GRID)
        elif kind < 0.65:
            wall.box((x, -1.0 * s, 0), (0.42 * s, 1.0 * s, 0.03 * s), palette.any(s))
            wall.ball((x + 0.34 * s, -1.0 * s, -0.06 * s), (0.03 * s,) * 3, palette.polished())
        elif kind < 0.8:
            wall.box((x, y, -0.12 * s), (w, 0.012 * s, 0.12 * s), frame)
            for _ in range(int(rng.integers(1, 5))):
                spot = wall.at(x + rng.uniform(-0.8, 0.8) * w, y, -0.12 * s)
                furniture.trinket(spot, palette, rng, s)
        elif kind < 0.88:
            wall.wall((x, y, -0.01 * s), w, h, palette.polished(mirror=rng.uniform(0.7, 0.95)))
        else:
            cloth = palette.textured(0.5 * s) if rng.random() < 0.5 else palette.plain()
            for fold in range(int(rng.integers(4, 9))):
                at = (x + fold * 0.09 * s, -height * 0.5, -0.05 * s)
                wall.post(at, 0.055 * s, height * 0.45, cloth)


def street(rng: np.random.Generator, palette: Palette, view: Viewpoint) -> tuple[Scene, float]:
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
        x, z = _spot(rng, view, far_m=60 * s)
        if np.hypot(x, z) < view.nearest_m + 1.5 * s:
            continue
        make = furniture.OUTDOOR[rng.integers(len(furniture.OUTDOOR))]
        rolls = rng.random() < 0.2
        velocity = np.array([0, 0, rng.normal(0, 5)]) if rolls else np.zeros(3)
        spot = Builder(turn_y(float(rng.normal(0, 0.2))), np.array([x, 0, z]), velocity, b.rows)
        make(spot, palette, rng, s * rng.uniform(0.9, 1.3))
    _float(Builder(rows=b.rows), palette, rng, view, int(rng.choice([0, 0, 4])), far_m=20 * s,
           up_m=camera_height, moving=0.3)  # fmt: skip
    sun = np.array([rng.normal(0, 60), -rng.uniform(40, 120), rng.uniform(-40, 60)]) * s
    lights = (
        Light(sun, _light_color(rng, 1.6), 1000 * s),
        Light(np.array([0, -30.0 * s, 0]), _light_color(rng, 0.3), 1000 * s),
    )
    target = np.array([0, 0, 15.0 * s])
    scene = _scene(b, rng, palette, lights, target, 0.35, frame_m=60 * s, sky=True)
    return scene, float(camera_height)


def swarm(rng: np.random.Generator, palette: Palette, view: Viewpoint) -> tuple[Scene, float]:
    """Many textured things afloat before a textured far background; the camera is at height 0."""
    far = view.nearest_m * float(np.exp(rng.uniform(np.log(4), np.log(40))))
    b = Builder()
    span = far * np.tan(min(view.half_angle, 1.2)) * 2.5
    tilt = look_along(np.array([rng.normal(0, 0.3), rng.normal(0, 0.2), 1.0]))
    b.add(Shape.QUAD, (0, 0, far), (span, span, 1.0), palette.textured(span * 0.5), rotation=tilt)
    if rng.random() < 0.5:
        b.floor((0, far * rng.uniform(0.1, 0.4), 0), span, span * 2, palette.textured(far * 0.4))
    count = int(rng.integers(8, 36))
    _float(b, palette, rng, view, count, far_m=far, up_m=0.0, moving=0.6, large=True)
    lamp = np.array([rng.normal(0, 0.4), -0.8, -0.2]) * far
    lights = (
        Light(lamp, _light_color(rng, 1.5), 3 * far),
        Light(rng.normal(0, 0.5, 3) * far, _light_color(rng, 0.6), 2 * far),
    )
    target = np.array([0, 0, far * 0.6])
    return _scene(b, rng, palette, lights, target, 0.8, frame_m=far, sky=True), 0.0


def _float(
    b: Builder, palette: Palette, rng: np.random.Generator, view: Viewpoint, count: int, *,
    far_m: float, up_m: float, moving: float, large: bool = False,
) -> None:  # fmt: skip
    """Things afloat in view, some of them travelling and spinning."""
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


def _spot(rng: np.random.Generator, view: Viewpoint, *, far_m: float) -> tuple[float, float]:
    """A place on the floor in view, near ones as likely as far ones."""
    distance = view.nearest_m * (far_m / view.nearest_m) ** rng.uniform(0.1, 1)
    angle = rng.uniform(-1, 1) * min(view.half_angle * 1.1, 1.4)
    return float(distance * np.sin(angle)), float(distance * np.cos(angle))


def _light_color(rng: np.random.Generator, strength: float) -> NDArray[np.float64]:
    warm = rng.normal(0, 0.12)
    return np.array([1 + warm, 1.0, 1 - warm]) * strength * rng.uniform(0.5, 1.5)


def _scene(
    b: Builder, rng: np.random.Generator, palette: Palette, lights: tuple[Light, Light],
    target: NDArray[np.float64], half_angle: float, *, frame_m: float, sky: bool = False,
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
        frame_m=frame_m,
    )
