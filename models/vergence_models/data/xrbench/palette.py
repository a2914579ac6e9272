"""Random surfaces, by their purpose."""

from __future__ import annotations

import numpy as np

from vergence_models.data.xrbench.things import RGB, Finish, Surface

_WOODS = ((0.42, 0.25, 0.13), (0.22, 0.11, 0.06), (0.62, 0.45, 0.28))
_FABRICS = ("weave", "plaid", "stripes", "clouds", "speckle")


class SurfacePalette:
    """Every call draws a new surface; the same generator draws the same ones."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def plain(self, *, tone: float | None = None, finish: Finish = Finish.MATTE) -> Surface:
        """Paint of one colour, without any texture to match."""
        level = self._rng.uniform(0.15, 0.8) if tone is None else tone
        return Surface(finish, self._tinted(level, 0.05), self._rng.uniform(0.1, 0.35))

    def wood(self, span_m: float = 0.8) -> Surface:
        """Varnished or raw, mostly with grain."""
        finish = Finish.SATIN if self._rng.random() < 0.5 else Finish.MATTE
        if self._rng.random() < 0.15:
            color = _WOODS[self._rng.integers(len(_WOODS))]
            return Surface(finish, color, self._rng.uniform(0.1, 0.3))
        return self.patterned("wood", span_m=span_m, finish=finish)

    def fabric(self, span_m: float = 0.4) -> Surface:
        if self._rng.random() < 0.3:
            return Surface(Finish.MATTE, self._tinted(self._rng.uniform(0.1, 0.7), 0.15))
        return self.patterned(*_FABRICS, span_m=span_m)

    def ceramic(self) -> Surface:
        if self._rng.random() < 0.5:
            return self.plain(finish=Finish.SATIN)
        return self.patterned("dots", "stripes", "clouds", span_m=0.15, finish=Finish.SATIN)

    def leaf(self) -> Surface:
        r, g, b = np.array([0.1, 0.3, 0.07]) * self._rng.uniform(0.6, 1.6)
        return Surface(Finish.MATTE, (float(r), float(g), float(b)))

    def metal(self) -> Surface:
        """Brushed: its highlights are wide enough that depth still shows."""
        tone = self._rng.uniform(0.4, 0.85)
        return Surface(Finish.METAL, self._tinted(tone, 0.04), self._rng.uniform(0.18, 0.4))

    def mirror(self) -> Surface:
        return Surface(Finish.MIRROR, (0.9, 0.9, 0.9))

    def glass(self) -> Surface:
        return Surface(Finish.GLASS, (0.96, 0.98, 0.97))

    def screen(self) -> Surface:
        """A switched-off display."""
        return Surface(Finish.SATIN, (0.01, 0.01, 0.012), 0.08)

    def picture(self) -> Surface:
        kind = str(self._rng.choice(["print", "patchwork", "clouds", "stones"]))
        return self.patterned(kind, span_m=float(self._rng.uniform(0.4, 0.9)))

    def patterned(self, *kinds: str, span_m: float, finish: Finish = Finish.MATTE) -> Surface:
        return Surface(
            finish,
            roughness=float(self._rng.uniform(0.12, 0.35)),
            pattern=str(self._rng.choice(kinds)),
            pattern_seed=int(self._rng.integers(2**31)),
            span_m=float(span_m * self._rng.uniform(0.7, 1.4)),
        )

    def _tinted(self, level: float, spread: float) -> RGB:
        r, g, b = np.clip(level + self._rng.normal(0, spread, 3), 0.02, 0.9)
        return float(r), float(g), float(b)
