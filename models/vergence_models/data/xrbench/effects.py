"""Effects of the final pass's camera: rows exposed one after the other, glare, the tone curve.

Motion blur, rolling shutter, flicker and defocus all follow from the schedule of an exposure: each
instant is rendered for the rows that are open then, through one point of the lens.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vergence_models.data.xrbench.recipe import Effects
from vergence_models.data.xrbench.tracer import Planes

_FEWEST_STEPS = 6  # instants of an exposure: enough for the flicker's wave and points of the lens
_STEP_PX = 1.5  # images of one exposure that lie closer than this melt into a streak
# Scattered light: shares, and how far it gets as a share of the image's width.
_HALOS = ((0.6, 0.008), (0.4, 0.04))


@dataclass(frozen=True, slots=True, eq=False)
class Instant:
    """A moment of an exposure, and the rows that gather light in it."""

    time_s: float  # relative to mid-exposure of the middle row
    first_row: int
    open: NDArray[np.bool_]  # [rows]: of the band that is rendered
    lens_m: tuple[float, float]  # the point of the lens that light comes through


def schedule(effects: Effects, height: int, moved_px: float) -> list[Instant]:
    """The instants of one frame; any two rows are open in the same number of them, to one.

    `moved_px` is the motion of objects in the image during the exposure. All bands have the same
    number of rows, so that one compiled camera renders them all.
    """
    # A shorter exposure would need more bands than it is worth; none at all cannot be divided by.
    exposure_s = max(effects.exposure_s, effects.readout_s / 16, 1e-9)
    steps = max(_FEWEST_STEPS, math.ceil(moved_px / _STEP_PX))
    span_s = effects.readout_s + exposure_s
    count = math.ceil(steps * span_s / exposure_s)
    times = (np.arange(count) + 0.5) / count * span_s - span_s / 2
    row_s = (np.arange(height) / max(height - 1, 1) - 0.5) * effects.readout_s
    # A hair more than half, so that rounding closes no row of a global shutter.
    is_open = np.abs(times[:, None] - row_s) <= exposure_s / 2 * (1 + 1e-9)
    rows = int(is_open.sum(1).max())
    instants = []
    for index, (time_s, opened) in enumerate(zip(times, is_open, strict=True)):
        first = min(int(np.argmax(opened)), height - rows)
        band = opened[first : first + rows]
        lens_m = _lens_point(index % steps, steps, effects.aperture_m / 2)
        instants.append(Instant(float(time_s), first, band, lens_m))
    return instants


def _lens_point(index: int, count: int, radius_m: float) -> tuple[float, float]:
    """Evenly over a disc (Vogel's sunflower); any `count` points in a row cover it."""
    radius = radius_m * math.sqrt((index + 0.5) / count)
    angle = index * math.pi * (3 - math.sqrt(5))
    return radius * math.cos(angle), radius * math.sin(angle)


def lamp_gain(effects: Effects, time_s: float) -> float:
    """The brightness of the lamps at a time, 1 on average."""
    return 1 + effects.flicker * math.sin(2 * math.pi * effects.flicker_hz * time_s)


def with_glare(radiance: Planes, share: float) -> Planes:
    """Spread a share of the light around where it fell; none is added or lost."""
    if share == 0:
        return radiance
    spread = np.zeros_like(radiance)
    for weight, width in _HALOS:
        sigma = max(width * radiance.shape[1], 0.5)
        # Reflected at the border, what leaves the image comes back in.
        spread += weight * np.asarray(
            cv2.GaussianBlur(radiance, (0, 0), sigma, borderType=cv2.BORDER_REFLECT)
        )
    return (1 - share) * radiance + share * spread


def auto_exposure(radiance: Planes) -> float:
    """The gain that puts the geometric mean of a picture at a fifth of white."""
    return float(0.2 / np.exp(np.log(radiance.mean(-1) + 1e-4).mean()))


def as_srgb(radiance: Planes, gain: float) -> NDArray[np.uint8]:
    """Linear light to uint8 sRGB, clipped at white."""
    linear = np.clip(radiance * gain, 0, 1)
    curve = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.asarray(curve * 255 + 0.5, np.uint8)
