"""Clips whose images do not show the disparity: sigma must say so.

- *blinded*: a covered lens, a black, white or grey picture, or mere noise, in one eye or in both.
- *unmatched*: the right eye sees something else, or the same beyond the range of the search.
- *repeating*: stripes, checks and tiles, which match at many disparities alike, and bars along
  the rows, which match at all of them.

Each begins with a clip or in mid-stream. The true disparity there gives way to the negative of one
that is possible. The loss does not teach disparity with it, but sigma: so sigma learns the spread
of what is possible (see ``networks/losses.py``).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vergence_models.data.clips import StereoClips

FARTHEST_PX = 190.0  # possible disparities end here, a little below the range of the search
EYES = (("left",), ("right",), ("left", "right"), ("left", "right"))

Images = Tensor  # uint8 [T, H, W, 3]
Levels = NDArray[np.float64]
Hidden = Callable[[StereoClips, StereoClips, np.random.Generator], StereoClips]


def without_evidence(
    clips: StereoClips,
    random: np.random.Generator,
    *,
    blinded_share: float,
    unmatched_share: float,
    repeating_share: float,
) -> StereoClips:
    """Each clip of a batch as it is, or, with these probabilities, as one of the three kinds."""
    kinds: tuple[tuple[float, Hidden], ...] = (
        (blinded_share, blinded),
        (unmatched_share, unmatched),
        (repeating_share, repeating),
    )
    return StereoClips.concatenate(
        [_one_of(kinds, clips, index, random) for index in range(len(clips))]
    )


def blinded(clip: StereoClips, other: StereoClips, random: np.random.Generator) -> StereoClips:
    """One clip; from some frame on an eye or both see nothing, everywhere or in a window."""
    frames, height, width = clip.disparity_px.shape[1:]
    shown = _stretch(frames, random)
    rows, columns = _part(height, width, random, whole=0.75)
    images = {"left": clip.left.clone(), "right": clip.right.clone()}
    for eye in EYES[random.integers(len(EYES))]:
        nothing = torch.stack([_nothing(height, width, random) for _ in range(frames)[shown]])
        images[eye][0, shown, rows, columns] = nothing[:, rows, columns]
    return replace(
        clip, **images, disparity_px=_possible(clip, other, random, shown, rows, columns)
    )


def unmatched(clip: StereoClips, other: StereoClips, random: np.random.Generator) -> StereoClips:
    """One clip; from some frame on the right eye sees another scene, or is out of range."""
    frames, height, width = clip.disparity_px.shape[1:]
    shown = _stretch(frames, random)
    scene = other.right[0, shown].flip(1)
    if random.random() < 0.5:  # as if everything came nearer by more than the range
        nearer = int(random.integers(int(0.75 * width), width))
        scene[:, :, : width - nearer] = clip.right[0, shown, :, nearer:]
    right = clip.right.clone()
    right[0, shown] = scene
    whole = (slice(0, height), slice(0, width))
    return replace(clip, right=right, disparity_px=_possible(clip, other, random, shown, *whole))


def repeating(clip: StereoClips, other: StereoClips, random: np.random.Generator) -> StereoClips:
    """One clip; from some frame on a wall whose pattern repeats along the rows.

    A wall that fills the image may be at any distance. That of a window shows where it ends, so
    its truth stays one.
    """
    frames, height, width = clip.disparity_px.shape[1:]
    shown = _stretch(frames, random)
    rows, columns = _part(height, width, random, whole=0.7)
    disparity = float(np.exp(random.uniform(np.log(2), np.log(120))))
    beside = slice(*(max(0, round(end - disparity)) for end in (columns.start, columns.stop)))
    pattern = _pattern(height, width, random)
    noise = random.uniform(0, 4)

    def seen(shift: float) -> Images:
        level = pattern(shift)[None] + random.normal(0, noise, (frames, height, width, 3))
        return torch.from_numpy(level.round().clip(0, 255).astype(np.uint8))[shown]

    whole = columns == slice(0, width) and rows == slice(0, height)
    left, right, truth = clip.left.clone(), clip.right.clone(), clip.disparity_px.clone()
    poses = clip.world_from_left.clone()
    if whole:
        beside = columns
        poses[:, shown] = poses[:, shown][:, :1]
    left[0, shown, rows, columns] = seen(0.0)[:, rows, columns]
    right[0, shown, rows, beside] = seen(disparity)[:, rows, beside]
    truth[0, shown, rows, columns] = -disparity if whole else disparity
    return replace(clip, left=left, right=right, disparity_px=truth, world_from_left=poses)


def _one_of(
    kinds: tuple[tuple[float, Hidden], ...],
    clips: StereoClips,
    index: int,
    random: np.random.Generator,
) -> StereoClips:
    clip = clips[index : index + 1]
    following = (index + 1) % len(clips)
    draw = random.random()
    for share, hidden in kinds:
        if draw < share:
            return hidden(clip, clips[following : following + 1], random)
        draw -= share
    return clip


def _stretch(frames: int, random: np.random.Generator) -> slice:
    """Frames without evidence: often from the first one on, mostly up to the last one."""
    first = 0 if random.random() < 0.4 else int(random.integers(frames))
    last = frames if random.random() < 0.7 else int(random.integers(first, frames)) + 1
    return slice(first, last)


def _part(
    height: int, width: int, random: np.random.Generator, *, whole: float
) -> tuple[slice, slice]:
    """Rows and columns: of the whole image with that probability, or of a window."""
    if random.random() < whole:
        return slice(0, height), slice(0, width)
    return _window(height, random), _window(width, random)


def _window(size: int, random: np.random.Generator) -> slice:
    low, high = np.sort(random.integers(0, size + 1, 2)).tolist()
    return slice(low, high)


def _possible(
    clip: StereoClips,
    other: StereoClips,
    random: np.random.Generator,
    shown: slice,
    rows: slice,
    columns: slice,
) -> Tensor:
    """The truth, but in these frames and pixels the negative of what could be there as well.

    That is the disparity of another scene, at any scale up to the range of the search.
    """
    scene = other.disparity_px[0, shown].flip(-1)
    scale = float(random.uniform(2, FARTHEST_PX)) / max(float(scene.mean()), 1.0)
    possible = (scene * scale).clamp(1, FARTHEST_PX)
    truth = clip.disparity_px.clone()
    truth[0, shown, rows, columns] = -possible[:, rows, columns]
    return truth


def _nothing(height: int, width: int, random: np.random.Generator) -> Tensor:
    """uint8 [H, W, 3]: one level, perhaps with a gradient, and a camera's noise, or noise alone."""
    kind = random.choice(["black", "white", "grey", "noise", "gradient"])
    level = {"black": random.uniform(0, 6), "white": random.uniform(248, 255)}.get(
        kind, random.uniform(0, 255)
    )
    image = np.full((height, width, 3), level)
    if kind == "gradient":
        across, down = random.uniform(-120, 120, 2)
        image += (across * np.linspace(-1, 1, width))[:, None]
        image += (down * np.linspace(-1, 1, height))[:, None, None]
    sigma = random.uniform(8, 60) if kind == "noise" else random.choice([0.0, random.uniform(0, 4)])
    channels = 1 if random.random() < 0.5 else 3
    image += random.normal(0, sigma, (height, width, channels))
    return torch.from_numpy(image.round().clip(0, 255).astype(np.uint8))


def _pattern(height: int, width: int, random: np.random.Generator) -> Callable[[float], Levels]:
    """A wall as a function of its shift along the rows: grey levels [H, W, 3]."""
    channels = 1 if random.random() < 0.5 else 3
    low, high = np.sort(random.uniform(5, 250, (2, channels)), axis=0)
    kind = random.choice(["stripes", "stripes", "checks", "checks", "tiles", "bars"])
    period = float(np.exp(random.uniform(np.log(6), np.log(64))))
    down = float(np.exp(random.uniform(np.log(6), np.log(64))))
    slope = random.uniform(-0.4, 0.4) if random.random() < 0.5 else 0.0
    sharp = random.random() < 0.6
    x, y = np.arange(width)[None, :], np.arange(height)[:, None]
    tile = random.random((height, max(round(period), 2)))
    if random.random() < 0.5:  # larger grains
        tile = np.repeat(np.repeat(tile, 3, axis=0), 3, axis=1)[:height]

    def levels(shift: float) -> Levels:
        match kind:
            case "tiles":
                u = x + round(shift) + 0 * y
                share = tile[y, u % tile.shape[1]]
            case "bars":
                share = tile[y, 0 * x] if sharp else _wave(y / down, sharp=False) + 0 * x
            case "checks":
                across = np.sin(2 * np.pi * (x + shift) / period)
                share = _squared(across * np.sin(2 * np.pi * y / down), sharp=sharp)
            case _:
                share = _wave((x + shift + slope * y) / period, sharp=sharp)
        return np.asarray(low + (high - low) * share[..., None])

    return levels


def _wave(periods: Levels, *, sharp: bool) -> Levels:
    return _squared(np.sin(2 * np.pi * periods), sharp=sharp)


def _squared(wave: Levels, *, sharp: bool) -> Levels:
    """From -1 to 1, to 0 to 1; sharp edges if asked for."""
    return ((np.tanh(6 * wave) if sharp else wave) + 1) / 2
