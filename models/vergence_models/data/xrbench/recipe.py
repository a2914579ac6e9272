"""Recipes: everything that a sequence depends on, as JSON; and the sets that we render."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

KINDS = ("living_room", "office", "kitchen", "bedroom", "studio", "playroom")

_NUMBERS = {"int": (int,), "float": (int, float)}  # by annotation


class BadRecipe(ValueError):
    """A recipe asks for something that cannot be rendered; the message says what to change."""


@dataclass(frozen=True, slots=True)
class Effects:
    """The effects of the final pass's camera; zero switches an effect off."""

    exposure_s: float = 0.008  # how long each row is exposed
    readout_s: float = 0.012  # from the first row's exposure to the last one's
    aperture_m: float = 0.003  # diameter of the lens
    focus_m: float = 2.0
    glare: float = 0.06  # share of the light that the lens scatters
    flicker: float = 0.25  # relative amplitude of the lamps' brightness
    flicker_hz: float = 100.0


@dataclass(frozen=True, slots=True)
class Recipe:
    """One sequence. The same recipe renders the same sequence."""

    room: str
    seed: int = 1
    frames: int = 48
    fps: float = 30.0
    speed: float = 1.0  # speed of the head along its path; frame k at 6 is frame 6 k at 1
    width: int = 640
    height: int = 480
    fov_deg: float = 70.0  # across the width
    baseline_m: float = 0.10
    samples: int = 32  # light paths a pixel
    bounces: int = 4
    denoise: bool = True
    effects: Effects = field(default_factory=Effects)

    def __post_init__(self) -> None:
        if self.room not in KINDS:
            raise BadRecipe(f"no room {self.room!r}; there are {', '.join(KINDS)}")
        for each in dataclasses.fields(self):
            value, wanted = getattr(self, each.name), _NUMBERS.get(str(each.type))
            if wanted and (isinstance(value, bool) or not isinstance(value, wanted)):
                raise BadRecipe(f"{each.name} must be of type {each.type}, got {value!r}")
        at_least_one = ("frames", "samples", "bounces")
        for name in at_least_one:
            if getattr(self, name) < 1:
                raise BadRecipe(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in ("fps", "baseline_m"):
            if not getattr(self, name) > 0:
                raise BadRecipe(f"{name} must be positive, got {getattr(self, name)}")
        if min(self.width, self.height) < 8:
            raise BadRecipe(f"images must be 8x8 at least, got {self.width}x{self.height}")
        if not 10 <= self.fov_deg <= 140:
            raise BadRecipe(f"fov_deg must lie in 10..140, got {self.fov_deg}")
        if self.speed < 0 or self.seed < 0:
            raise BadRecipe(f"speed and seed must not be negative: {self.speed}, {self.seed}")
        for name, value in dataclasses.asdict(self.effects).items():
            if not isinstance(value, int | float) or not 0 <= value < math.inf:
                raise BadRecipe(f"effects.{name} must be a number from 0 on, got {value!r}")
        if not (self.effects.glare <= 1 and self.effects.flicker <= 1 and self.effects.focus_m):
            raise BadRecipe("effects.glare and .flicker are shares up to 1; focus_m is positive")

    @property
    def name(self) -> str:
        """The sequence's folder, unlike that of any other recipe in a set."""
        return f"{self.room}_{self.seed}_{self.speed:g}x"

    @property
    def focal_px(self) -> float:
        return self.width / 2 / math.tan(math.radians(self.fov_deg) / 2)

    def to_json(self) -> str:
        return json.dumps(dataclasses.asdict(self), indent=1) + "\n"

    @classmethod
    def from_json(cls, text: str, origin: Path) -> Self:
        """Read a recipe. Raises BadRecipe: no JSON, an unknown field, or an impossible value."""
        try:
            fields: dict[str, Any] = json.loads(text)  # whatever a person wrote
            effects = Effects(**fields.pop("effects", {}))
            return cls(**fields, effects=effects)
        except (TypeError, AttributeError, json.JSONDecodeError) as error:
            raise BadRecipe(f"{origin}: no recipe: {error}") from None
        except BadRecipe as error:
            raise BadRecipe(f"{origin}: {error}") from None


def _benchmark() -> tuple[Recipe, ...]:
    """Every room once at the head's own speed, and two at higher ones."""
    faster = (("living_room", 6.0), ("office", 6.0), ("living_room", 20.0), ("office", 20.0))
    return (
        *(Recipe(room, seed=1) for room in KINDS),
        *(Recipe(room, seed=1, speed=speed) for room, speed in faster),
    )


SETS: dict[str, tuple[Recipe, ...]] = {
    "benchmark": _benchmark(),
    "small": tuple(
        dataclasses.replace(recipe, frames=12, width=320, height=240, samples=24)
        for recipe in _benchmark()
    ),
    # What models/xrbench_sample holds.
    "sample": (Recipe("playroom", frames=2, speed=6.0, width=160, height=120, samples=64),),
}
