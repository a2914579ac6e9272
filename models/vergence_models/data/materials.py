"""Materials of surfaces: a texture with gain and bias, gloss, mirroring and glow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

RGB = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Material:
    """Reflectance is ``(bias + gain * texture) ** 2``: gain 0 is a plain colour."""

    texture: int  # index into the bank
    span_m: float  # metres that one repeat of the texture covers
    gain: RGB = (1.0, 1.0, 1.0)
    bias: RGB = (0.0, 0.0, 0.0)
    offset: tuple[float, float] = (0.0, 0.0)  # shift of the texture, in repeats
    specular: float = 0.0
    shininess: float = 20.0
    mirror: float = 0.0  # share of the colour that comes from reflected surroundings
    glow: float = 0.0

    def row(self) -> list[float]:
        shine = (self.specular, self.shininess, self.mirror, self.glow)
        return [self.texture, self.span_m, *self.offset, *self.gain, *self.bias, *shine]


MATERIAL_COLUMNS = 14


class MaterialPalette:
    """Draws random materials from a bank's textures."""

    def __init__(self, rng: np.random.Generator, kinds: tuple[str, ...]) -> None:
        self._rng = rng
        self._by_kind: dict[str, list[int]] = {}
        for index, kind in enumerate(kinds):
            self._by_kind.setdefault(kind, []).append(index)
        self._all = np.arange(len(kinds))

    def texture(self, *kinds: str) -> int:
        """A random texture of the named kinds, or of any where the bank has none of them."""
        fitting = [index for kind in kinds for index in self._by_kind.get(kind, [])]
        return int(self._rng.choice(fitting or self._all))

    def plain(self, *, tone: float | None = None) -> Material:
        """Paint: nearly one colour, with the faintest structure."""
        rng = self._rng
        level = rng.uniform(0.25, 0.95) if tone is None else tone
        color = np.clip(level + rng.normal(0, 0.06, 3), 0.05, 0.98)
        gain = float(rng.choice([0.0, 0.01, 0.03]))
        r, g, b = (float(c - gain / 2) for c in color)
        return Material(
            self.texture("clouds", "speckle"),
            rng.uniform(0.5, 2),
            (gain,) * 3,
            (r, g, b),
            specular=self._gloss(0.3),
        )

    def textured(self, size_m: float, *kinds: str) -> Material:
        """A texture whose repeat is about the size of what it covers, recoloured at random."""
        rng = self._rng
        gain = rng.choice([0.35, 0.7, 1.0, 1.0]) * (1 + rng.normal(0, 0.1, 3))
        bias = rng.uniform(0, 1) * np.maximum(0.9 - gain, 0)
        return Material(
            self.texture(*kinds) if kinds else int(rng.choice(self._all)),
            float(size_m * np.exp(rng.uniform(np.log(0.25), np.log(1.5)))),
            tuple(gain), tuple(bias), tuple(rng.uniform(0, 1, 2)),
            specular=self._gloss(0.3), shininess=float(np.exp(rng.uniform(1.5, 5))),
        )  # fmt: skip

    def any(self, size_m: float) -> Material:
        """Mostly textured, sometimes plain, now and then polished."""
        draw = self._rng.random()
        if draw < 0.2:
            return self.plain()
        if draw < 0.26:
            return self.polished()
        return self.textured(size_m)

    def wood(self, size_m: float) -> Material:
        return self.textured(size_m, "wood")

    def polished(self, *, mirror: float | None = None) -> Material:
        """Metal, glass or a mirror: mostly its surroundings are visible in it."""
        share = float(self._rng.uniform(0.2, 0.9)) if mirror is None else mirror
        r, g, b = np.clip(self._rng.uniform(0.2, 0.7) + self._rng.normal(0, 0.04, 3), 0, 1)
        return Material(
            self.texture("clouds"), 1.0, (0.02,) * 3, (float(r), float(g), float(b)),
            specular=0.8, shininess=60.0, mirror=share,
        )  # fmt: skip

    def lamp(self) -> Material:
        return Material(self.texture("clouds"), 1.0, (0.0,) * 3, (0.95, 0.93, 0.88), glow=1.5)

    def _gloss(self, chance: float) -> float:
        return float(self._rng.uniform(0.05, 0.8)) if self._rng.random() < chance else 0.0
