"""Indoor scenes: furnished rooms, and close-ups of cluttered tables and floors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vergence_models.data import furniture
from vergence_models.data.materials import MaterialPalette
from vergence_models.data.scenes import Builder, PointLight, Scene, turn_y
from vergence_models.data.shapes import Cutout
from vergence_models.data.surroundings import Viewpoint, compose, float_about, light_color, spot


def room(
    rng: np.random.Generator, palette: MaterialPalette, view: Viewpoint
) -> tuple[Scene, float]:
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
        x, z = spot(rng, view, far_m=float(half.max()) * 1.8)
        radius = 0.6 * s
        if inside(x, z, 0.4 * s) and np.hypot(x, z) > view.nearest_m + radius:
            turned = -yaw + float(rng.choice([0, np.pi / 2, np.pi, -np.pi / 2]))
            turned += float(rng.normal(0, 0.3)) if rng.random() < 0.5 else 0.0
            make = furniture.INDOOR[rng.integers(len(furniture.INDOOR))]
            place = Builder(turn_y(turned), np.array([x, 0.0, z]), rows=b.rows)
            make(place, palette, rng, s)
            placed += 1
        if placed >= wanted:
            break
    floating = int(rng.choice([0, 0, 2, 5]))
    float_about(
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
        PointLight(lamp + np.array([0, 0.05 * s, 0]), light_color(rng, 1.6), 3 * s),
        PointLight(center + rng.normal(0, 1.5 * s, 3) * (1, 0, 1) - (0, height * 0.6, 0),
              light_color(rng, 0.6), 3 * s),
    )  # fmt: skip
    target = lamp + np.array([0.01, 1.0, 0.02])
    scene = compose(b, rng, palette, lights, target, np.radians(68))
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
    b: Builder, palette: MaterialPalette, rng: np.random.Generator, half: NDArray[np.float64],
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
    wall: Builder,
    palette: MaterialPalette,
    rng: np.random.Generator,
    width: float,
    height: float,
    s: float,
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
                place = wall.at(x + rng.uniform(-0.8, 0.8) * w, y, -0.12 * s)
                furniture.trinket(place, palette, rng, s)
        elif kind < 0.88:
            wall.wall((x, y, -0.01 * s), w, h, palette.polished(mirror=rng.uniform(0.7, 0.95)))
        else:
            cloth = palette.textured(0.5 * s) if rng.random() < 0.5 else palette.plain()
            for fold in range(int(rng.integers(4, 9))):
                at = (x + fold * 0.09 * s, -height * 0.5, -0.05 * s)
                wall.post(at, 0.055 * s, height * 0.45, cloth)


def clutter(
    rng: np.random.Generator, palette: MaterialPalette, view: Viewpoint
) -> tuple[Scene, float]:
    """A close-up of many things on a surface before a wall, and the camera's height over it."""
    near = view.nearest_m
    far = near * rng.uniform(2.0, 5.0)
    camera_height = near * rng.uniform(0.3, 1.0)
    b = Builder()
    backdrop = b.at(0, 0, far, yaw=float(rng.normal(0, 0.3)))
    b.floor((0, 0, far), far * 3, far * 3, palette.any(far * 0.5))
    backdrop.wall((0, -far, 0), far * 4, far * 2, palette.any(far * 0.7))
    if rng.random() < 0.4:  # a side wall, or the inside of a corner
        turn = float(rng.choice([-1, 1])) * rng.uniform(0.9, 1.6)
        away = far * rng.uniform(0.6, 1.2)
        side = b.at(0, 0, far * 0.5, yaw=turn).at(0, 0, away)
        side.wall((0, -far, 0), far * 2, far * 2, palette.any(far * 0.7))
    for _ in range(int(rng.integers(10, 30))):
        x, z = spot(rng, view, far_m=far)
        size = near * float(np.exp(rng.uniform(np.log(0.3), np.log(1.4))))
        distance = float(np.hypot(x, z))
        if distance < near + 0.35 * size:
            continue
        place = Builder(turn_y(float(rng.uniform(0, 6.3))), np.array([x, 0.0, z]), rows=b.rows)
        draw = rng.random()
        if draw < 0.35:
            furniture.trinket(place, palette, rng, size * 2)
        elif draw < 0.5:
            furniture.plant(place, palette, rng, size)
        elif draw < 0.6:
            _sticks(place, palette, rng, size)
        else:
            make = furniture.INDOOR[rng.integers(len(furniture.INDOOR))]
            make(place, palette, rng, size * 0.7)
    float_about(
        Builder(rows=b.rows), palette, rng, view, int(rng.choice([0, 0, 3, 8])),
        far_m=far, up_m=camera_height, moving=0.3,
    )  # fmt: skip
    lamp = np.array(
        [rng.normal(0, 0.6) * far, -far * rng.uniform(0.8, 2.0), rng.normal(0, 0.4) * far]
    )
    lights = (
        PointLight(lamp, light_color(rng, 1.6), 2 * far),
        PointLight(
            rng.normal(0, 1, 3) * far * (1, 0, 1) - (0, far, 0), light_color(rng, 0.5), 2 * far
        ),
    )
    target = np.array([0.0, 0.0, far * 0.6])
    return compose(b, rng, palette, lights, target, 0.9), float(camera_height)


def _sticks(b: Builder, palette: MaterialPalette, rng: np.random.Generator, s: float) -> None:
    """Thin rods that lean and cross."""
    skin = palette.any(0.3 * s)
    for _ in range(int(rng.integers(3, 12))):
        foot = rng.normal(0, 0.25, 3) * s * (1, 0, 1)
        top = foot + rng.normal(0, 0.35, 3) * s * (1, 0, 1) - (0, s * rng.uniform(0.4, 1.5), 0)
        b.rod(foot, top, s * rng.uniform(0.004, 0.03), skin)
