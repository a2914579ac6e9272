"""Procedural texture images: noise, wood, bricks, tiles, weave, stripes, dots, stone, print."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Field = NDArray[np.float32]  # [S, S], 0..1
Colors = NDArray[np.float32]  # [3, 3]: three RGB colours, 0..1


def pattern(rng: np.random.Generator, size: int, kind: str | None = None) -> NDArray[np.uint8]:
    """Draw one pattern of a random (or the named) kind: uint8 [size, size, 3], RGB."""
    name = kind or str(rng.choice(list(PATTERNS)))
    image = PATTERNS[name](rng, size, _palette(rng))
    grain = noise(rng, size, exponent=0.3)[..., None] - 0.5
    return np.clip((image + grain * rng.uniform(0.02, 0.15)) * 255 + 0.5, 0, 255).astype(np.uint8)


def noise(rng: np.random.Generator, size: int, *, exponent: float, stretch: float = 1.0) -> Field:
    """Periodic noise, amplitude ~ frequency ** -exponent; stretch > 1 draws fibres along x."""
    fy = np.fft.fftfreq(size)[:, None]
    fx = np.fft.rfftfreq(size)[None, :] * stretch
    amplitude = (fx * fx + fy * fy + size**-2.0) ** (-exponent / 2)
    shape = (size, size // 2 + 1)
    spectrum = amplitude * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape))
    spectrum[0, 0] = 0
    field = np.fft.irfft2(spectrum, s=(size, size))
    return np.asarray(np.clip(field / (5 * field.std()) + 0.5, 0, 1), np.float32)


def _palette(rng: np.random.Generator) -> Colors:
    base = rng.uniform(0.1, 0.95)
    tint = rng.normal(0, rng.choice([0.03, 0.1, 0.3]), (3, 3))
    shade = base + rng.normal(0, 0.22, (3, 1))
    return np.clip(shade + tint, 0.02, 0.98).astype(np.float32)


def _blend(colors: Colors, field: NDArray[np.floating]) -> NDArray[np.float32]:
    """0 gives the first colour, 0.5 the second, 1 the third."""
    f = np.clip(field, 0, 1)[..., None] * 2
    lower = colors[0] + (colors[1] - colors[0]) * np.minimum(f, 1)
    return np.asarray(lower + (colors[2] - colors[1]) * np.maximum(f - 1, 0), np.float32)


def _grid(size: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    y, x = np.mgrid[:size, :size] / size
    return y, x


def _clouds(rng: np.random.Generator, size: int, colors: Colors) -> NDArray[np.float32]:
    return _blend(colors, noise(rng, size, exponent=float(rng.uniform(0.6, 1.8))))


def _wood(rng: np.random.Generator, size: int, colors: Colors) -> NDArray[np.float32]:
    y, x = _grid(size)
    tone = np.array([0.36, 0.22, 0.12]) * rng.uniform(0.6, 2.2)
    planks = int(rng.choice([1, 3, 5, 8]))
    plank = (y * planks).astype(int)
    shift = rng.uniform(0, 1, planks)[plank]
    rings = noise(rng, size, exponent=1.6, stretch=10)
    grain = np.sin((y * rng.uniform(4, 10) + rings * 3 + shift * 9) * 2 * np.pi) * 0.12
    fibres = noise(rng, size, exponent=0.8, stretch=20) - 0.5
    seam = (np.abs((y * planks) % 1) < 0.006 * planks) | (np.abs((x + shift) % 1) < 0.005)
    level = 0.9 + grain + fibres * 0.5 + (shift - 0.5) * 0.3 - 0.45 * (seam & (planks > 1))
    return np.asarray(np.clip(tone * level[..., None], 0, 1), np.float32)


def _bricks(rng: np.random.Generator, size: int, colors: Colors) -> NDArray[np.float32]:
    y, x = _grid(size)
    rows = int(rng.choice([6, 8, 12]))
    row = (y * rows).astype(int)
    across = (x * rows / 2 + (row % 2) * 0.5) % (rows / 2)
    brick = across.astype(int)
    tone = rng.uniform(0, 1, (rows, rows))[row, brick]
    mortar = ((y * rows) % 1 < 0.12) | (across % 1 < 0.06)
    field = np.where(mortar, 1.0, tone * 0.5)
    return _blend(colors, field + 0.3 * (noise(rng, size, exponent=1.0) - 0.5))


def _tiles(rng: np.random.Generator, size: int, colors: Colors) -> NDArray[np.float32]:
    y, x = _grid(size)
    n = int(rng.choice([2, 4, 6, 10]))
    i, j = (y * n).astype(int), (x * n).astype(int)
    checks = ((i + j) % 2) * float(rng.choice([0.0, 0.6]))
    tone = checks + 0.3 * rng.uniform(0, 1, (n, n))[i, j]
    joint = ((y * n) % 1 < 0.03) | ((x * n) % 1 < 0.03)
    veins = noise(rng, size, exponent=1.4) - 0.5
    return _blend(colors, np.where(joint, 1.0, tone + 0.4 * veins))


def _weave(rng: np.random.Generator, size: int, colors: Colors) -> NDArray[np.float32]:
    y, x = _grid(size)
    n = int(rng.choice([24, 40, 64]))
    threads = np.sin(x * n * 2 * np.pi) * np.sin(y * n * 2 * np.pi)
    return _blend(colors, 0.5 + 0.3 * threads + 0.5 * (noise(rng, size, exponent=1.0) - 0.5))


def _stripes(rng: np.random.Generator, size: int, colors: Colors) -> NDArray[np.float32]:
    y, x = _grid(size)
    along = y if rng.random() < 0.5 else x
    edges = np.sort(rng.uniform(0, 1, int(rng.choice([6, 14, 30]))))
    tones = rng.uniform(0, 1, len(edges) + 1)
    return _blend(colors, tones[np.searchsorted(edges, along)])


def _plaid(rng: np.random.Generator, size: int, colors: Colors) -> NDArray[np.float32]:
    state = rng.integers(2**31)
    vertical = _stripes(np.random.default_rng(state), size, colors)
    return 0.5 * (vertical + vertical.transpose(1, 0, 2))


def _dots(rng: np.random.Generator, size: int, colors: Colors) -> NDArray[np.float32]:
    y, x = _grid(size)
    n = int(rng.choice([4, 8, 16]))
    i, j = (y * n).astype(int), (x * n).astype(int)
    dy = y * n - i - 0.5 - rng.uniform(-0.2, 0.2, (n, n))[i, j]
    dx = x * n - j - 0.5 - rng.uniform(-0.2, 0.2, (n, n))[i, j]
    inside = dx * dx + dy * dy < rng.uniform(0.01, 0.14, (n, n))[i, j]
    return _blend(colors, np.where(inside, rng.uniform(0.5, 1, (n, n))[i, j], 0.0))


def _stones(rng: np.random.Generator, size: int, colors: Colors) -> NDArray[np.float32]:
    y, x = _grid(size)
    n = int(rng.choice([20, 60, 120]))
    centre = rng.uniform(0, 1, (n, 2))
    first = np.full((size, size), 9.0)
    second = first.copy()
    cell = np.zeros((size, size), int)
    for k, (cy, cx) in enumerate(centre):
        dy, dx = np.abs(y - cy), np.abs(x - cx)
        d = np.minimum(dy, 1 - dy) ** 2 + np.minimum(dx, 1 - dx) ** 2
        cell = np.where(d < first, k, cell)
        second = np.minimum(second, np.maximum(d, first))
        first = np.minimum(first, d)
    gap = np.sqrt(second) - np.sqrt(first)
    tone = 0.3 + 0.7 * rng.uniform(0, 1, n)[cell]
    tone = tone * np.clip(gap * np.sqrt(n) * 4, 0, 1)
    return _blend(colors, tone + 0.3 * (noise(rng, size, exponent=1.0) - 0.5))


def _speckle(rng: np.random.Generator, size: int, colors: Colors) -> NDArray[np.float32]:
    field = noise(rng, size, exponent=float(rng.uniform(0.1, 0.9)))
    return _blend(colors, (field > 0.62) * 0.5 + (field < 0.36) * 1.0)


def _print(rng: np.random.Generator, size: int, colors: Colors) -> NDArray[np.float32]:
    """Lines of words, as on a page, a label or a poster."""
    image = np.broadcast_to(np.maximum(colors[0], 0.6), (size, size, 3)).astype(np.float32)
    lines = int(rng.choice([8, 14, 24]))
    height = size // lines
    for line in range(lines):
        x = int(rng.integers(2, size // 10))
        ink = colors[1 + int(rng.random() < 0.15)] * 0.5
        while x < size * 0.92 and rng.random() > 0.06:
            word = int(rng.integers(height // 2, height * 4))
            top = line * height + height // 4
            strokes = rng.random(max(word // 2, 1)) < 0.7
            columns = x + np.flatnonzero(np.repeat(strokes, 2))
            image[top : top + height // 2, columns[columns < size - 2]] = ink
            x += word + height // 2
    return image


def _patchwork(rng: np.random.Generator, size: int, colors: Colors) -> NDArray[np.float32]:
    """Overlapping flat rectangles: sharp edges of every length and contrast."""
    image = np.broadcast_to(colors[0], (size, size, 3)).astype(np.float32)
    for _ in range(int(rng.choice([20, 60, 200]))):
        h, w = (rng.uniform(0.02, 0.35, 2) * size).astype(int) + 1
        y, x = rng.integers(0, size, 2)
        color = _blend(colors, rng.uniform(0, 1, (1, 1)))[0, 0]
        image[y : y + h, x : x + w] = np.clip(color + rng.normal(0, 0.08, 3), 0, 1)
    return image


PATTERNS: dict[str, Callable[[np.random.Generator, int, Colors], NDArray[np.float32]]] = {
    "clouds": _clouds,
    "wood": _wood,
    "bricks": _bricks,
    "tiles": _tiles,
    "weave": _weave,
    "stripes": _stripes,
    "plaid": _plaid,
    "dots": _dots,
    "stones": _stones,
    "speckle": _speckle,
    "print": _print,
    "patchwork": _patchwork,
}
