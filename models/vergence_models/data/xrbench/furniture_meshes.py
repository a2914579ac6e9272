"""Parametric furniture. Each maker builds one thing on a bench.

The thing stands on the floor (y = 0, up is -y) around the origin, its front towards -z, and all
of it lies within the footprint that `FloorPlan` gave it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vergence_models.data.xrbench import meshes
from vergence_models.data.xrbench.palette import SurfacePalette
from vergence_models.data.xrbench.things import Finish, Workbench

Maker = Callable[[Workbench, SurfacePalette, np.random.Generator], None]


def table(b: Workbench, p: SurfacePalette, rng: np.random.Generator) -> None:
    """Four legs, or one below a round top; now and then the top is glass."""
    half_x, half_z = rng.uniform(0.45, 0.8), rng.uniform(0.35, 0.5)
    height = rng.uniform(0.68, 0.78)
    wood = p.wood()
    top = p.glass() if rng.random() < 0.2 else wood
    if rng.random() < 0.3:
        b.add(top, meshes.post(half_z, 0.015), (0, -height, 0))
        b.add(wood, meshes.post(0.04, height / 2), (0, -height / 2, 0))
        b.add(wood, meshes.post(half_z * 0.6, 0.015), (0, -0.015, 0))
    else:
        b.box(top, (0, -height, 0), (half_x, 0.016, half_z))
        b.legs(wood, half_x - 0.05, half_z - 0.05, height, rng.uniform(0.015, 0.035))
    set_out(b, p, rng, half_x * 0.7, half_z * 0.6, -height - 0.016, count=int(rng.integers(2, 6)))


def coffee_table(b: Workbench, p: SurfacePalette, rng: np.random.Generator) -> None:
    half_x, half_z, height = rng.uniform(0.35, 0.6), rng.uniform(0.25, 0.35), 0.4
    wood = p.wood()
    b.box(wood, (0, -height, 0), (half_x, 0.02, half_z))
    b.box(wood, (0, -0.15, 0), (half_x - 0.06, 0.012, half_z - 0.06))
    b.legs(p.metal() if rng.random() < 0.5 else wood, half_x - 0.03, half_z - 0.03, height, 0.015)
    set_out(b, p, rng, half_x * 0.7, half_z * 0.6, -height - 0.02, count=int(rng.integers(1, 4)))


def chair(b: Workbench, p: SurfacePalette, rng: np.random.Generator) -> None:
    """Its back is made of slats or of thin rods."""
    wood, half, height = p.wood(), rng.uniform(0.19, 0.24), 0.45
    back = height + rng.uniform(0.4, 0.55)
    seat = p.fabric() if rng.random() < 0.5 else wood
    b.box(seat, (0, -height, 0), (half, 0.025, half))
    thick = rng.uniform(0.012, 0.02)
    b.legs(wood, half - thick, half - thick, height, thick)
    for x in (-half + thick, half - thick):
        b.box(wood, (x, -(height + back) / 2, half - thick), (thick, (back - height) / 2, thick))
    b.box(wood, (0, -back, half - thick), (half, 0.03, thick))
    if rng.random() < 0.5:
        for y in np.linspace(height + 0.12, back - 0.1, int(rng.integers(2, 4))):
            b.box(wood, (0, -y, half - thick), (half - thick, 0.025, 0.006))
    else:
        for x in np.linspace(-half, half, int(rng.integers(5, 9)))[1:-1]:
            ends = ((x, -height, half - thick), (x, -back, half - thick))
            b.rods(wood, 0.006, ends)


def sofa(b: Workbench, p: SurfacePalette, rng: np.random.Generator) -> None:
    fabric, half_x, half_z = p.fabric(), rng.uniform(0.7, 1.05), 0.42
    b.box(fabric, (0, -0.2, 0), (half_x, 0.12, half_z))
    seats = 2 if half_x < 0.85 else 3
    width = half_x / seats
    for k in range(seats):
        x = (2 * k + 1) * width - half_x
        b.box(fabric, (x * 0.92, -0.38, -0.03), (width * 0.9, 0.07, half_z - 0.08))
    b.box(fabric, (0, -0.5, half_z - 0.1), (half_x, 0.35, 0.1))
    for x in (-half_x + 0.08, half_x - 0.08):
        b.box(fabric, (x, -0.34, 0), (0.08, 0.28, half_z))
    for _ in range(int(rng.integers(1, 4))):
        x = rng.uniform(-0.7, 0.7) * half_x
        b.add(p.fabric(0.3), meshes.ball((0.2, 0.19, 0.07)), (x, -0.62, 0.17))
    b.legs(p.wood(), half_x - 0.08, half_z - 0.08, 0.1, 0.02)


def bed(b: Workbench, p: SurfacePalette, rng: np.random.Generator) -> None:
    half_x, wood = rng.uniform(0.5, 0.85), p.wood()
    b.box(wood, (0, -0.16, 0), (half_x, 0.1, 1.0))
    b.legs(wood, half_x - 0.05, 0.9, 0.1, 0.03)
    b.box(wood, (0, -0.55, 0.97), (half_x, 0.5, 0.03))
    b.box(p.plain(tone=0.7), (0, -0.34, -0.02), (half_x - 0.03, 0.09, 0.94))
    b.box(p.fabric(0.6), (0, -0.38, -0.3), (half_x - 0.005, 0.08, 0.68))
    for x in np.linspace(-half_x, half_x, 5)[1:-1:2]:
        b.add(p.fabric(0.5), meshes.ball((0.3, 0.1, 0.2)), (x, -0.5, 0.68))


def cabinet(b: Workbench, p: SurfacePalette, rng: np.random.Generator) -> None:
    """Drawers with knobs, and things on top."""
    body, knob = p.wood(), p.metal()
    half_x, half_y, half_z = rng.uniform(0.3, 0.6), rng.uniform(0.35, 0.55), rng.uniform(0.18, 0.25)
    front = p.plain() if rng.random() < 0.3 else body
    b.box(body, (0, -half_y, 0.015), (half_x, half_y, half_z - 0.03))
    rows, columns = int(rng.integers(2, 5)), int(rng.integers(1, 3))
    for i in range(rows):
        for j in range(columns):
            x = (2 * (j + 0.5) / columns - 1) * half_x
            y = -2 * (i + 0.5) / rows * half_y
            half = (half_x / columns - 0.012, half_y / rows - 0.012, 0.008)
            b.box(front, (x, y, 0.015 - half_z + 0.022), half)
            b.add(knob, meshes.ball((0.012,) * 3), (x, y, 0.015 - half_z))
    set_out(b, p, rng, half_x * 0.8, half_z * 0.5, -2 * half_y, count=int(rng.integers(1, 4)))


def wardrobe(b: Workbench, p: SurfacePalette, rng: np.random.Generator) -> None:
    """Two doors; one may be a mirror."""
    body, half_x, half_y = p.wood(1.2), rng.uniform(0.5, 0.8), rng.uniform(0.95, 1.1)
    b.box(body, (0, -half_y, 0.02), (half_x, half_y, 0.26))
    for x in (-half_x / 2, half_x / 2):
        shiny = x < 0 and rng.random() < 0.5
        door = p.mirror() if shiny else body
        b.box(door, (x, -half_y, -0.25), (half_x / 2 - 0.01, half_y - 0.03, 0.01))
        b.box(p.metal(), (x * 0.12, -half_y, -0.275), (0.008, 0.09, 0.012))


def bookshelf(b: Workbench, p: SurfacePalette, rng: np.random.Generator) -> None:
    wood, thick = p.wood(), 0.011
    half_x, half_y, half_z = rng.uniform(0.35, 0.6), rng.uniform(0.6, 1.05), 0.14
    boards = int(rng.integers(3, 6))
    gap = 2 * half_y / boards
    for x in (-half_x, half_x):
        b.box(wood, (x, -half_y, 0), (thick, half_y, half_z))
    if rng.random() < 0.7:
        b.box(wood, (0, -half_y, half_z - thick), (half_x, half_y, thick))
    for i in range(boards + 1):
        b.box(wood, (0, -i * gap, 0), (half_x, thick, half_z))
    covers = [p.plain() if rng.random() < 0.4 else p.patterned("print", "clouds", span_m=0.2)
              for _ in range(7)]  # fmt: skip
    for i in range(boards):
        if rng.random() < 0.2:
            set_out(b, p, rng, half_x * 0.7, 0.05, -i * gap - thick, count=2, tall_m=gap - 0.05)
            continue
        x = -half_x + 2 * thick
        while x < half_x - 0.08 and rng.random() > 0.06:
            half, tall = rng.uniform(0.008, 0.025), (gap - 0.04) * rng.uniform(0.3, 0.49)
            cover = covers[int(rng.integers(len(covers)))]
            b.box(cover, (x + half, -i * gap - tall - thick, -0.02), (half * 0.97, tall, 0.1))
            x += 2 * half + (rng.uniform(0, 0.15) if rng.random() < 0.1 else 0.001)


def desk(b: Workbench, p: SurfacePalette, rng: np.random.Generator) -> None:
    """A desk with a display, a keyboard, a lamp on a thin arm."""
    half_x, half_z, height = rng.uniform(0.6, 0.8), 0.36, 0.73
    b.box(p.wood(), (0, -height, 0), (half_x, 0.015, half_z))
    metal, dark = p.metal(), p.plain(tone=0.05, finish=Finish.SATIN)
    b.legs(metal, half_x - 0.04, half_z - 0.04, height, 0.02)
    top = -height - 0.015
    for x in (-0.25, 0.32) if rng.random() < 0.5 else (0.0,):
        b.box(dark, (x, top - 0.34, 0.16), (0.27, 0.17, 0.012))
        b.box(p.screen(), (x, top - 0.34, 0.146), (0.255, 0.155, 0.003))
        b.add(dark, meshes.post(0.015, 0.1), (x, top - 0.1, 0.19))
        b.add(dark, meshes.post(0.1, 0.006), (x, top - 0.006, 0.19))
    b.box(p.plain(tone=0.3), (0, top - 0.01, -0.15), (0.2, 0.01, 0.065))
    for row in np.linspace(-0.19, -0.11, 5):
        for x in np.linspace(-0.18, 0.18, 13):
            b.box(dark, (x, top - 0.022, row), (0.011, 0.004, 0.0075))
    x = half_x - 0.12
    b.add(metal, meshes.post(0.07, 0.01), (x, top - 0.01, 0.1))
    elbow, head = (x + 0.02, top - 0.36, 0.16), (x - 0.2, top - 0.5, 0.0)
    b.rods(metal, 0.007, ((x, top, 0.1), elbow), (elbow, head))
    b.add(metal, meshes.lathe([(0.02, -0.06), (0.03, -0.04), (0.075, 0.04)]), head)
    set_out(b, p, rng, half_x * 0.5, 0.05, top, count=2, tall_m=0.12, front_m=-0.25)


def office_chair(b: Workbench, p: SurfacePalette, rng: np.random.Generator) -> None:
    fabric, dark = p.fabric(), p.plain(tone=0.05, finish=Finish.SATIN)
    b.box(fabric, (0, -0.48, -0.02), (0.24, 0.04, 0.23))
    b.box(fabric, (0, -0.85, 0.23), (0.22, 0.26, 0.03))
    b.rods(dark, 0.02, ((0, -0.05, 0), (0, -0.46, 0)), ((0, -0.46, 0.1), (0, -0.7, 0.25)))
    for angle in np.linspace(0, 2 * np.pi, 6)[:-1]:
        foot = (0.24 * np.cos(angle), -0.05, 0.24 * np.sin(angle))
        b.rods(dark, 0.014, ((0, -0.09, 0), foot))
        b.add(dark, meshes.ball((0.028,) * 3), (foot[0], -0.028, foot[2]))


def plant(b: Workbench, p: SurfacePalette, rng: np.random.Generator) -> None:
    """A pot and bent leaves to all sides."""
    radius, green = rng.uniform(0.11, 0.17), [p.leaf() for _ in range(3)]
    b.add(p.ceramic(), meshes.lathe(
        [(0.02, -2 * radius + 0.03), (radius * 0.93, -2 * radius + 0.03), (radius, -2 * radius),
         (radius * 0.7, 0.0)]))  # fmt: skip
    stem = rng.uniform(0.1, 0.6)
    foot, top = (0.0, -1.7 * radius, 0.0), (0.0, -2 * radius - stem, 0.0)
    b.rods(p.wood(0.2), 0.012, (foot, top))
    for k in range(int(rng.integers(14, 30))):
        length = rng.uniform(0.18, 0.38)
        blade = meshes.leaf(length, length * rng.uniform(0.15, 0.4), bend=rng.uniform(0.1, 0.7))
        tilt = meshes.turn_y_to(_unit(np.array([0.6, -rng.uniform(0.3, 1.4), 0.0])))
        around = rng.uniform(0, 2 * np.pi)
        c, s = np.cos(around), np.sin(around)
        turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ tilt
        b.add(green[k % 3], blade, (0, -2 * radius - stem * rng.uniform(0.2, 1.0), 0), turn=turn)


def floor_lamp(b: Workbench, p: SurfacePalette, rng: np.random.Generator) -> None:
    """A thin post with a paper shade."""
    metal, height = p.metal(), rng.uniform(1.4, 1.7)
    b.add(metal, meshes.post(0.14, 0.012), (0, -0.012, 0))
    b.add(metal, meshes.post(0.009, height / 2), (0, -height / 2, 0))
    b.add(p.plain(tone=0.8), meshes.lathe([(0.1, -0.14), (0.18, 0.14)]), (0, -height, 0))


def clothes_rack(b: Workbench, p: SurfacePalette, rng: np.random.Generator) -> None:
    """Thin tubes with cloth that hangs in folds."""
    metal, half, height = p.metal(), rng.uniform(0.4, 0.6), 1.5
    for x in (-half, half):
        b.rods(metal, 0.012, ((x, 0, 0), (x, -height, 0)), ((x, -0.02, -0.2), (x, -0.02, 0.2)))
    b.rods(metal, 0.012, ((-half, -height, 0), (half, -height, 0)))
    for x in np.arange(-half + 0.1, half - 0.1, 0.07):
        if rng.random() < 0.75:
            drop, cloth = rng.uniform(0.3, 0.5), p.fabric()
            b.box(cloth, (x, -height + 0.08 + drop, 0), (0.012, drop, rng.uniform(0.12, 0.2)),
                  yaw=rng.normal(0, 0.15))  # fmt: skip
            b.rods(metal, 0.003, ((x, -height, 0), (x, -height + 0.09, 0)))


def set_out(
    b: Workbench, p: SurfacePalette, rng: np.random.Generator, half_x: float, half_z: float,
    y_m: float, *, count: int, tall_m: float = 0.35, front_m: float = 0.0,
) -> None:  # fmt: skip
    """Put small things side by side on a surface at height y."""
    for x in np.linspace(-half_x, half_x, 2 * count + 1)[1::2]:
        one = Workbench()
        trinket(one, p, rng, tall_m)
        z = front_m + rng.uniform(-half_z, half_z)
        b.take(one, (float(x), y_m, float(z)), yaw=float(rng.uniform(0, 6.3)))


def trinket(b: Workbench, p: SurfacePalette, rng: np.random.Generator, tall_m: float) -> None:
    """A cup, a bottle, a vase, a ball, a bowl or a pile of books."""
    kind, tall = int(rng.integers(6)), min(tall_m, rng.uniform(0.08, 0.3))
    if kind == 0:
        b.add(p.ceramic(), meshes.lathe([(0.035, -0.09), (0.032, 0), (0.001, 0)]))
    elif kind == 1:
        shape = [(0.012, -1), (0.012, -0.75), (0.03, -0.6), (0.035, -0.4), (0.035, 0), (0.001, 0)]
        skin = p.glass() if rng.random() < 0.5 else p.ceramic()
        b.add(skin, meshes.lathe(np.array(shape) * (1, tall)))
    elif kind == 2:
        along = np.linspace(-1, 0, 12)
        swell = 0.05 + 0.025 * np.sin(4.5 * along + rng.uniform(0, 6))
        b.add(p.ceramic(), meshes.lathe(np.stack([swell, along * tall], 1)))
    elif kind == 3:
        radius = min(tall / 2, 0.07)
        b.add(p.ceramic(), meshes.ball((radius,) * 3), (0, -radius, 0))
    elif kind == 4:
        b.add(p.ceramic(), meshes.lathe([(0.09, -0.07), (0.07, -0.02), (0.03, 0), (0.001, 0)]))
    else:
        y = 0.0
        while y < tall - 0.06 and rng.random() < 0.8:
            half = rng.uniform(0.008, 0.02)
            cover = p.patterned("print", "clouds", "stripes", span_m=0.2)
            b.box(cover, (0, -y - half, 0), (0.11, half * 0.98, 0.08), yaw=rng.normal(0, 0.2))
            y += 2 * half


def _unit(vector: meshes.Matrix) -> meshes.Matrix:
    return vector / np.linalg.norm(vector)
