"""The flaws of real cameras, added to clean images. Ground truth stays as it is.

Every effect is drawn for each clip from one numpy generator, so a pool of clean clips yields new
images in every epoch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vergence_models.data.clips import StereoClips

Image = NDArray[np.uint8]  # [H, W, 3], RGB
_NOISE_POOL = 1 << 20  # normal numbers drawn a batch; frames take random stretches of them


@dataclass(frozen=True, slots=True)
class SensorConfig:
    """The probability of each effect in a clip, and its largest strength."""

    noise: float = 0.8
    noise_levels: float = 7.0  # standard deviation, grey levels
    tone: float = 0.8  # exposure, gain, gamma, colour of both eyes
    mismatch: float = 0.6  # the same, between the eyes
    flicker: float = 0.2  # brightness changes from frame to frame
    vignetting: float = 0.3
    defocus: float = 0.35
    motion_blur: float = 0.25
    motion_blur_px: float = 6.0
    misalignment: float = 0.5  # the right image is rectified by a calibration that is a little off
    misalignment_px: float = 0.6  # vertical: a shift, and as much by a turn and by a slant
    offset_px: float = 0.25  # horizontal, standard deviation; no method can see it in the images
    jpeg: float = 0.3
    grey: float = 0.15  # a monochrome pair


def film_as_sensor(
    clips: StereoClips, rng: np.random.Generator, config: SensorConfig | None = None
) -> StereoClips:
    """The same clips, as recorded by cameras with flaws (computed on the CPU)."""
    config = config or SensorConfig()
    noise = rng.standard_normal(_NOISE_POOL, dtype=np.float32)
    left, right = torch.empty_like(clips.left), torch.empty_like(clips.right)
    for index in range(len(clips)):
        one = _Recording(rng, config, clips.left.shape[1:], noise)
        left[index] = one.eye(clips.left[index], right=False)
        right[index] = one.eye(clips.right[index], right=True)
    return replace(clips, left=left, right=right)


class _Recording:
    """The flaws drawn for one clip: optics first, then the sensor, then the codec."""

    def __init__(
        self, rng: np.random.Generator, config: SensorConfig, shape: torch.Size,
        noise: NDArray[np.float32],
    ) -> None:  # fmt: skip
        def happens(chance: float) -> bool:
            return bool(rng.random() < chance)

        frames, height, width, _ = shape
        self._rng = rng
        self._noise = noise
        off = happens(config.misalignment)
        self._misaligned = _misaligned(rng, config, height, width) if off else None
        sigma = rng.uniform(0.3, 1.1) if happens(config.defocus) else 0.0
        self._sigmas_px: list[float] = (sigma * rng.uniform(0.7, 1.3, 2)).tolist()
        length, angle = rng.uniform(1.5, config.motion_blur_px), rng.uniform(0, np.pi)
        self._streak = _streak(length, angle) if happens(config.motion_blur) else None
        self._falloff = _vignette(height, width, rng.uniform(0.1, 0.6) * happens(config.vignetting))
        brightness = np.exp(rng.normal(0, 0.06, frames) * happens(config.flicker))
        tone = _tone(rng, spread=float(happens(config.tone)))
        mismatch = _tone(rng, spread=0.25 * happens(config.mismatch))
        tones = ((tone,), (tone, mismatch))
        self._curves = [[_curve(b, *eye) for b in brightness] for eye in tones]
        level = config.noise_levels * rng.uniform(0, 1) ** 2 * happens(config.noise)
        self._read_noise, self._shot_noise = level, level * rng.uniform(0, 1)
        self._grey = happens(config.grey)
        self._jpeg = int(rng.integers(35, 96)) if happens(config.jpeg) else None

    def eye(self, frames: Tensor, *, right: bool) -> Tensor:
        """Record frames uint8 [T, H, W, 3] of one eye."""
        images = np.ascontiguousarray(frames.cpu().numpy())
        recorded = [self._record(image, t, right) for t, image in enumerate(images)]
        return torch.from_numpy(np.stack(recorded)).to(frames.device)

    def _record(self, image: Image, frame: int, right: bool) -> Image:
        if right and self._misaligned is not None:
            size = image.shape[1::-1]
            image = _u8(
                cv2.warpAffine(image, self._misaligned, size, borderMode=cv2.BORDER_REPLICATE)
            )
        if self._sigmas_px[right] > 0:
            sigma = self._sigmas_px[right]
            image = _u8(cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE))
        if self._streak is not None:
            image = _u8(cv2.filter2D(image, -1, self._streak, borderType=cv2.BORDER_REPLICATE))
        curve = self._curves[right][frame]  # float32 [256, 3]: nothing is rounded before the noise
        signal = np.stack([curve[:, c].take(image[..., c]) for c in range(3)], axis=-1)
        signal *= self._falloff
        if self._read_noise > 0:
            start = int(self._rng.integers(_NOISE_POOL))
            noise = np.take(self._noise, np.arange(start, start + signal.size), mode="wrap")
            variance = signal * (self._shot_noise**2 / 255) + self._read_noise**2
            signal += noise.reshape(signal.shape) * np.sqrt(variance)
        image = np.clip(signal + 0.5, 0, 255).astype(np.uint8)
        if self._grey:
            grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
            image = _u8(cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB))
        return image if self._jpeg is None else _jpeg(image, self._jpeg)


def _u8(image: cv2.typing.MatLike) -> Image:
    return np.asarray(image, np.uint8)


def _misaligned(
    rng: np.random.Generator, config: SensorConfig, height: int, width: int
) -> NDArray[np.float64]:
    """Affine map [2, 3] of pixels that a calibration a little off leaves."""
    shift, turn, slant = rng.uniform(-1, 1, 3) * config.misalignment_px
    offset, stretch = rng.normal(0, config.offset_px, 2)
    # Each term but the shifts is nothing in the middle of the image, and that large at its sides.
    x, y = width / 2, height / 2
    return np.array(
        [[1 + stretch / x, 0, offset - stretch], [turn / x, 1 + slant / y, shift - turn - slant]]
    )


def _tone(rng: np.random.Generator, *, spread: float) -> tuple[float, float, NDArray[np.float64]]:
    """Gain, gamma and a tint [3], all near one."""
    gain = float(np.exp(rng.normal(0, 0.28 * spread)))
    gamma = float(np.exp(rng.normal(0, 0.2 * spread)))
    return gain, gamma, np.exp(rng.normal(0, 0.08 * spread, 3))


def _curve(
    brightness: float, *tones: tuple[float, float, NDArray[np.float64]]
) -> NDArray[np.float32]:
    """Grey levels 0..255 of each channel after tones and a change of brightness: [256, 3]."""
    level = np.repeat(np.arange(256)[:, None] / 255, 3, axis=1)
    for gain, gamma, tint in tones:
        level = level**gamma * gain * tint
    return (level * brightness * 255).astype(np.float32)


def _streak(length_px: float, angle: float) -> NDArray[np.float32]:
    """The path of a pixel during the exposure, drawn as a line with soft edges."""
    reach = int(np.ceil(length_px / 2)) + 1
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    along = np.abs(x * np.cos(angle) + y * np.sin(angle))
    across = np.abs(-x * np.sin(angle) + y * np.cos(angle))
    kernel = np.clip(length_px / 2 + 0.5 - along, 0, 1) * np.clip(1 - across, 0, 1)
    return np.asarray(kernel / kernel.sum(), np.float32)


def _vignette(height: int, width: int, strength: float) -> NDArray[np.float32]:
    v, u = np.linspace(-1, 1, height)[:, None], np.linspace(-1, 1, width)
    return (1 - strength * 0.5 * (u * u + v * v)).astype(np.float32)[..., None]


def _jpeg(image: Image, quality: int) -> Image:
    _, payload = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    decoded = cv2.imdecode(payload, cv2.IMREAD_COLOR)
    return np.ascontiguousarray(np.asarray(decoded, np.uint8)[..., ::-1])
