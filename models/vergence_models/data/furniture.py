"""Objects in rooms and streets, each built at the origin of a frame on the floor."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vergence_models.data.materials import Material, MaterialPalette
from vergence_models.data.scenes import Builder, look_along
from vergence_models.data.shapes import Cutout, Shape

Maker = Callable[[Builder, MaterialPalette, np.random.Generator, float], None]


def table(b: Builder, palette: MaterialPalette, rng: np.random.Generator, s: float) -> None:
    """A table with four legs or one, and objects on it. `s` is the scale, as in all makers."""
    top = palette.textured(s, "wood", "photo", "clouds", "tiles")
    w, d, h = rng.uniform(0.4, 0.9) * s, rng.uniform(0.3, 0.6) * s, rng.uniform(0.4, 0.8) * s
    thick = 0.02 * s
    if rng.random() < 0.3:
        b.post((0, -h, 0), d, thick, top)
        b.post((0, -h / 2, 0), 0.05 * s, h / 2, top)
        b.post((0, -0.03 * s, 0), d * 0.5, 0.02 * s, top, taper=-0.5)
    else:
        b.box((0, -h, 0), (w, thick, d), top)
        leg = rng.uniform(0.012, 0.04) * s
        for x in (-1, 1):
            for z in (-1, 1):
                b.box((x * (w - leg), -h / 2, z * (d - leg)), (leg, h / 2, leg), top)
    for _ in range(int(rng.integers(0, 5))):
        x, z = rng.uniform(-0.7, 0.7, 2) * (w, d) * 0.9
        trinket(b.at(x, -h - thick, z, yaw=rng.uniform(0, 6)), palette, rng, s)


def trinket(b: Builder, palette: MaterialPalette, rng: np.random.Generator, s: float) -> None:
    """A book pile, a vase, a ball, a cup or a lamp, to stand on something."""
    size = rng.uniform(0.04, 0.16) * s
    kind = rng.integers(5)
    if kind == 0:
        y = 0.0
        for _ in range(int(rng.integers(1, 5))):
            t = rng.uniform(0.01, 0.03) * s
            cover = palette.textured(0.3 * s)
            b.at(0, y, 0, yaw=rng.uniform(-0.4, 0.4)).box((0, -t, 0), (size, t, size * 0.7), cover)
            y -= 2 * t
    elif kind == 1:
        skin = palette.any(0.3 * s)
        b.post((0, -size, 0), size * 0.5, size, skin, taper=rng.uniform(-0.5, 0.5))
        for _ in range(int(rng.integers(0, 6))):
            tip = rng.normal(0, size * 0.7, 3) * (1, 0.5, 1) - (0, size * 4, 0)
            b.rod((0, -size * 2, 0), tip, 0.004 * s, skin)
            b.ball(tip, (size * 0.3, size * 0.2, size * 0.3), palette.textured(0.1 * s))
    elif kind == 2:
        b.ball((0, -size, 0), (size, size, size), palette.any(0.4 * s))
    elif kind == 3:
        b.post((0, -size * 0.6, 0), size * 0.4, size * 0.6, palette.any(0.2 * s), taper=0.1)
    else:
        stem = palette.polished()
        b.post((0, -size * 1.5, 0), 0.008 * s, size * 1.5, stem)
        b.post((0, -size * 3.2, 0), size, size * 0.7, palette.plain(tone=0.9), taper=-0.4)


def chair(b: Builder, palette: MaterialPalette, rng: np.random.Generator, s: float) -> None:
    wood = palette.wood(0.7 * s)
    seat = palette.textured(0.5 * s) if rng.random() < 0.6 else wood
    w, h, leg = rng.uniform(0.18, 0.26) * s, rng.uniform(0.4, 0.5) * s, rng.uniform(0.01, 0.025) * s
    back = h + rng.uniform(0.35, 0.6) * s
    b.box((0, -h, 0), (w, 0.025 * s, w), seat)
    for x in (-1, 1):
        b.post((x * (w - leg), -h / 2, -w + leg), leg, h / 2, wood)
        b.post((x * (w - leg), -back / 2, w - leg), leg, back / 2, wood)
    if rng.random() < 0.5:
        for y in np.linspace(h + 0.12 * s, back - 0.03 * s, int(rng.integers(2, 5))):
            b.box((0, -y, w - leg), (w, 0.02 * s, 0.008 * s), wood)
    else:
        for x in np.linspace(-w, w, int(rng.integers(4, 8)))[1:-1]:
            b.rod((x, -h, w - leg), (x, -back, w - leg), leg * 0.5, wood)
        b.box((0, -back, w - leg), (w, 0.03 * s, leg), wood)


def cabinet(b: Builder, palette: MaterialPalette, rng: np.random.Generator, s: float) -> None:
    body = palette.textured(s, "wood", "photo", "clouds") if rng.random() < 0.7 else palette.plain()
    w, h, d = rng.uniform(0.25, 0.7) * s, rng.uniform(0.3, 1.0) * s, rng.uniform(0.15, 0.3) * s
    b.box((0, -h, 0), (w, h, d), body)
    knob = palette.polished()
    rows, columns = int(rng.integers(1, 5)), int(rng.integers(1, 3))
    front = palette.plain() if rng.random() < 0.3 else body
    for i in range(rows):
        for j in range(columns):
            x, y = (2 * (j + 0.5) / columns - 1) * w, 2 * (i + 0.5) / rows * h
            half = (w / columns - 0.02 * s, h / rows - 0.02 * s, 0.012 * s)
            b.box((x, -y, -d), half, front)
            b.ball((x, -y, -d - 0.03 * s), (0.02 * s,) * 3, knob)
    for _ in range(int(rng.integers(0, 3))):
        trinket(b.at(rng.uniform(-w, w) * 0.7, -2 * h, 0), palette, rng, s)


def bookshelf(b: Builder, palette: MaterialPalette, rng: np.random.Generator, s: float) -> None:
    wood = palette.wood(s)
    w, h, d = rng.uniform(0.3, 0.6) * s, rng.uniform(0.5, 1.1) * s, 0.14 * s
    boards = int(rng.integers(3, 6))
    thick = 0.012 * s
    for x in (-w, w):
        b.box((x, -h, 0), (thick, h, d), wood)
    if rng.random() < 0.7:
        b.box((0, -h, d), (w, h, thick), wood)
    spacing = 2 * h / boards
    for i in range(boards + 1):
        b.box((0, -i * spacing, 0), (w, thick, d), wood)
    for i in range(boards):
        x = -w + 0.03 * s
        while x < w - 0.08 * s and rng.random() > 0.08:
            t = rng.uniform(0.012, 0.05) * s
            tall = spacing * rng.uniform(0.25, 0.42)
            cover = palette.any(0.2 * s)
            b.box((x + t, -i * spacing - tall - thick, -0.02 * s), (t, tall, d * 0.7), cover)
            x += 2 * t + (rng.uniform(0, 0.15) * s if rng.random() < 0.2 else 0.002 * s)


def sofa(b: Builder, palette: MaterialPalette, rng: np.random.Generator, s: float) -> None:
    fabric = palette.textured(0.4 * s, "weave", "plaid", "clouds", "photo")
    if rng.random() < 0.4:
        fabric = palette.plain()
    w, d = rng.uniform(0.45, 1.1) * s, 0.42 * s
    b.box((0, -0.22 * s, 0), (w, 0.2 * s, d), fabric)
    b.box((0, -0.5 * s, d - 0.1 * s), (w, 0.35 * s, 0.1 * s), fabric)
    for x in (-w, w):
        b.box((x, -0.32 * s, 0), (0.09 * s, 0.3 * s, d), fabric)
    for _ in range(int(rng.integers(0, 4))):
        x = rng.uniform(-w, w) * 0.7
        b.ball((x, -0.56 * s, 0.2 * s), (0.2 * s, 0.17 * s, 0.09 * s), palette.textured(0.3 * s))


def plant(b: Builder, palette: MaterialPalette, rng: np.random.Generator, s: float) -> None:
    """A pot with leaves on all sides."""
    r = rng.uniform(0.1, 0.2) * s
    b.post((0, -r, 0), r, r, palette.any(0.3 * s), taper=0.2)
    leaf = leaf_material(palette, rng, s)
    for _ in range(int(rng.integers(8, 22))):
        length = rng.uniform(0.08, 0.3) * s
        out = rng.normal(0, 1, 3) * (1, 0.5, 1) - (0, 0.8, 0)
        out /= np.linalg.norm(out)
        at = out * rng.uniform(0.15, 0.6) * s - (0, 2 * r, 0)
        # Leaves lie along the way out, with a random roll about it.
        turned = (
            look_along(out)
            @ _roll(rng.uniform(0, 3.1))
            @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
        )
        b.add(Shape.QUAD, at, (length * 0.45, length, 1.0), leaf, rotation=turned,
              cutout=Cutout.LEAF)  # fmt: skip


def leaf_material(palette: MaterialPalette, rng: np.random.Generator, s: float) -> Material:
    green = np.array([0.25, 0.5, 0.2]) * rng.uniform(0.5, 1.4) + rng.normal(0, 0.05, 3)
    r, g, c = (float(x) for x in np.clip(green, 0.02, 0.9))
    contrast = rng.uniform(0.1, 0.6)
    gain = (contrast * r + 0.05, contrast * g + 0.1, contrast * c + 0.05)
    span_m = rng.uniform(0.08, 0.5) * s
    return Material(palette.texture("clouds", "speckle", "stones"), span_m, gain, (r, g, c))


def floor_lamp(b: Builder, palette: MaterialPalette, rng: np.random.Generator, s: float) -> None:
    h = rng.uniform(1.2, 1.8) * s
    metal = palette.polished() if rng.random() < 0.5 else palette.plain()
    b.post((0, -h / 2, 0), rng.uniform(0.006, 0.02) * s, h / 2, metal)
    b.post((0, -0.01 * s, 0), 0.15 * s, 0.01 * s, metal)
    b.post((0, -h, 0), 0.17 * s, 0.13 * s, palette.lamp(), taper=-0.3)


def crates(b: Builder, palette: MaterialPalette, rng: np.random.Generator, s: float) -> None:
    y = 0.0
    for _ in range(int(rng.integers(1, 4))):
        half = rng.uniform(0.08, 0.3, 3) * s
        frame = b.at(rng.uniform(-0.1, 0.1) * s, y, 0, yaw=rng.uniform(0, 3))
        frame.box((0, -half[1], 0), half, palette.any(0.5 * s))
        y -= 2 * half[1]


def railing(b: Builder, palette: MaterialPalette, rng: np.random.Generator, s: float) -> None:
    """Thin upright bars below a rail."""
    bars = int(rng.integers(4, 12))
    spacing, h = rng.uniform(0.06, 0.16) * s, rng.uniform(0.7, 1.1) * s
    skin = palette.wood(s) if rng.random() < 0.5 else palette.plain()
    thick = rng.uniform(0.005, 0.018) * s
    for i in range(bars):
        b.post(((i - bars / 2) * spacing, -h / 2, 0), thick, h / 2, skin)
    b.box((-spacing / 2, -h, 0), (bars * spacing / 2, 0.02 * s, 0.03 * s), skin)


def pole(b: Builder, palette: MaterialPalette, rng: np.random.Generator, s: float) -> None:
    h = rng.uniform(1.0, 3.0) * s
    skin = palette.any(0.5 * s)
    b.post((0, -h / 2, 0), rng.uniform(0.01, 0.06) * s, h / 2, skin)
    if rng.random() < 0.4:
        round_sign = Cutout.DISC if rng.random() < 0.5 else Cutout.FULL
        b.wall((0, -h, -0.03), 0.25 * s, 0.25 * s, palette.textured(0.5 * s), cutout=round_sign)


def tree(b: Builder, palette: MaterialPalette, rng: np.random.Generator, s: float) -> None:
    trunk, h = rng.uniform(0.08, 0.25) * s, rng.uniform(1.5, 3.0) * s
    b.post((0, -h / 2, 0), trunk, h / 2, palette.textured(0.5 * s, "wood", "clouds"), taper=-0.2)
    leaf = leaf_material(palette, rng, 4 * s)
    for _ in range(int(rng.integers(2, 6))):
        at = rng.normal(0, 0.7, 3) * s - (0, h + 0.6 * s, 0)
        b.ball(at, rng.uniform(0.3, 1.0, 3) * s, leaf)
    for _ in range(int(rng.integers(10, 45))):
        turned = look_along(rng.normal(0, 1, 3))
        at = rng.normal(0, 1.0, 3) * s - (0, h + 0.5 * s, 0)
        half = (0.2 * s, rng.uniform(0.2, 0.45) * s, 1.0)
        b.add(Shape.QUAD, at, half, leaf, rotation=turned, cutout=Cutout.LEAF)


def car(b: Builder, palette: MaterialPalette, rng: np.random.Generator, s: float) -> None:
    shiny = rng.random() < 0.6
    paint = palette.polished(mirror=rng.uniform(0.1, 0.4)) if shiny else palette.plain()
    glass, tyre = palette.polished(mirror=0.6), palette.plain(tone=0.1)
    b.box((0, -0.65 * s, 0), (0.85 * s, 0.35 * s, 2.1 * s), paint)
    b.box((0, -1.2 * s, 0.2 * s), (0.75 * s, 0.25 * s, 1.1 * s), glass)
    b.box((0, -1.46 * s, 0.2 * s), (0.75 * s, 0.03 * s, 1.1 * s), paint)
    for x in (-0.8, 0.8):
        for z in (-1.3, 1.3):
            end = np.array([x * s, -0.33 * s, z * s])
            half = np.array([0.1 * s, 0, 0])
            b.rod(end - half, end + half, 0.33 * s, tyre)


def _roll(angle: float) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


INDOOR: tuple[Maker, ...] = (
    table, table, chair, chair, cabinet, bookshelf, sofa, plant, floor_lamp, crates, crates,
    railing, pole,
)  # fmt: skip
OUTDOOR: tuple[Maker, ...] = (tree, tree, car, car, pole, pole, railing, crates, plant)
