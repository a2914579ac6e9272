"""What a network asserts of images that do not show the disparity.

Blank images, patterns that match at several disparities, and surfaces nearer than the search
reaches; each as the first frame of a stream (cold), and in mid-stream (warm) a few frames after a
scene was seen. The confidence should be low. These images are not those of training.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from vergence_models.evaluation.stepping import (
    NO_MOTION,
    Image,
    Plane,
    State,
    StepInputs,
    SteppedNetwork,
)
from vergence_proto.accuracy import confidence_from_sigma

SURE = 40  # of 255: a chance of 16 % to be right within a pixel
COLD_ITERATIONS = 4
SEEN_FRAMES = 4  # frames that show a scene before a stream loses sight of it
BLANK_FRAMES = 2  # the confidence is that of this frame without evidence
SCENE_PX = 24  # disparity of the scene
WIDTH, HEIGHT = 320, 256
WIDE = 640  # where a surface beyond the range still has its match inside the image


class Pair(NamedTuple):
    left: Image  # uint8 [H, W, 3], RGB
    right: Image  # the same shape


@dataclass(frozen=True, slots=True)
class Doubt:
    """The confidence of one kind of input, 0 to 255."""

    cold: float  # median over the pixels
    warm: float
    cold_sure_pct: float  # share of pixels with a confidence above SURE
    warm_sure_pct: float


ImageMaker = Callable[[np.random.Generator], Image]
PairMaker = Callable[[np.random.Generator], Pair]
Levels = NDArray[np.float64]  # [H, W], grey


def doubts_of(network: SteppedNetwork) -> dict[str, Doubt]:
    """The confidence of a network in each kind of input, by the name of the kind."""
    return {name: doubt(network, make) for name, make in kinds(network.card.max_disparity_px)}


def doubt(network: SteppedNetwork, make: PairMaker, *, seed: int = 1) -> Doubt:
    """Step a network over one kind of input, cold and in mid-stream."""
    random = np.random.default_rng(seed)
    pair = make(random)
    cold, _ = _started(network, pair)
    height, width = pair.left.shape[:2]
    scene = textured(height, width, SCENE_PX, random)
    warm, state = _started(network, scene)
    for each in [scene] * (SEEN_FRAMES - 1) + [make(random) for _ in range(BLANK_FRAMES)]:
        left, right = (network.card.grown(image)[None] for image in each)
        found = network.run(StepInputs(left, right, NO_MOTION[None], state), 1)
        warm, state = _confidence(found.sigma_px, each), found.state
    sure = (100 * float((each > SURE).mean()) for each in (cold, warm))
    return Doubt(float(np.median(cold)), float(np.median(warm)), *sure)


def kinds(max_disparity_px: int) -> Iterator[tuple[str, PairMaker]]:
    """(name, maker) of every kind of input, for a search of that range."""
    blank: dict[str, ImageMaker] = {
        "black": _level(0, noise=0),
        "white": _level(255, noise=0),
        "grey": _level(128, noise=0),
        "covered lens": _level(4, noise=2),
        "noise": _level(128, noise=30),
        "gradient": _gradient,
    }
    for name, image in blank.items():
        yield f"{name}, both eyes", _in_eyes(image, left=True, right=True)
    for name in ("black", "covered lens", "noise"):
        yield f"{name}, left eye", _in_eyes(blank[name], left=True, right=False)
        yield f"{name}, right eye", _in_eyes(blank[name], left=False, right=True)
    for period in (8, 16, 32):
        yield f"stripes of {period} px", _pattern(lambda x, y, r, p=period: 1.0 * (x % p < p // 2))
    for size in (8, 16):
        yield f"checks of {size} px", _pattern(lambda x, y, r, s=size: (x // s + y // s) % 2)
    yield "slanted waves", _pattern(lambda x, y, r: (1 + np.sin((x + 0.3 * y) * 0.314)) / 2)
    for period in (16, 32):
        yield f"tiles of {period} px", _pattern(lambda x, y, r, p=period: _tile(p, r)[y, x % p])
    yield "bars along the rows", _pattern(lambda x, y, r: _tile(1, r)[y, 0 * x])
    for by in (8, 64):
        yield f"{by} px beyond the range", _wall(max_disparity_px + by)


def textured(height: int, width: int, disparity_px: int, random: np.random.Generator) -> Pair:
    """A wall of random texture of several scales at one disparity."""
    wide = texture(height, width + disparity_px, random)
    return Pair(wide[:, :width].copy(), wide[:, disparity_px:].copy())


def texture(height: int, width: int, random: np.random.Generator) -> Image:
    """Random texture of several scales."""
    total = np.zeros((height, width, 3))
    for step, share in ((2, 1.0), (5, 1.0), (13, 1.2), (40, 1.5)):
        grains = random.standard_normal((height // step + 3, width // step + 3, 3))
        total += share * cv2.resize(grains, (width, height), interpolation=cv2.INTER_CUBIC)
    return _as_image(128 + 45 * (total - total.mean()) / total.std())


def _started(network: SteppedNetwork, pair: Pair) -> tuple[NDArray[np.uint8], State]:
    left, right = (network.card.grown(image)[None] for image in pair)
    _, sigma_px, state = network.start(left, right, COLD_ITERATIONS)
    return _confidence(sigma_px, pair), state


def _confidence(sigma_px: Plane, pair: Pair) -> NDArray[np.uint8]:
    height, width = pair.left.shape[:2]
    return confidence_from_sigma(sigma_px[0, :height, :width])


def _as_image(levels: Levels) -> Image:
    return np.asarray(levels.round().clip(0, 255), np.uint8)


def _level(grey: float, *, noise: float) -> ImageMaker:
    return lambda random: _as_image(grey + noise * random.standard_normal((HEIGHT, WIDTH, 3)))


def _gradient(random: np.random.Generator) -> Image:
    across, down = np.linspace(70, 190, WIDTH), np.linspace(0, 30, HEIGHT)[:, None]
    return _as_image(np.repeat((across + down)[..., None], 3, axis=2))


def _in_eyes(image: ImageMaker, *, left: bool, right: bool) -> PairMaker:
    """The image in these eyes, the scene in the other one."""

    def make(random: np.random.Generator) -> Pair:
        scene = textured(HEIGHT, WIDTH, SCENE_PX, random)
        return Pair(image(random) if left else scene.left, image(random) if right else scene.right)

    return make


def _wall(disparity_px: int) -> PairMaker:
    return lambda random: textured(HEIGHT, WIDE, disparity_px, random)


def _tile(width: int, random: np.random.Generator) -> Levels:
    return texture(HEIGHT, width, random)[..., 0] / 255


def _pattern(level: Callable[..., Levels]) -> PairMaker:
    """Grey levels from 0 to 1 as a function of x and y; the right eye sees it shifted."""

    def make(random: np.random.Generator) -> Pair:
        x, y = np.arange(WIDTH)[None, :], np.arange(HEIGHT)[:, None]
        shift, seed = int(random.integers(40)), int(random.integers(1 << 30))
        left, right = (
            _as_image(40 + 160 * (level(x + by, y, np.random.default_rng(seed)) + 0.0 * x * y))
            for by in (0, shift)
        )
        return Pair(*(np.repeat(image[..., None], 3, axis=2) for image in (left, right)))

    return make
