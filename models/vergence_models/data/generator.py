"""Stereo video of random scenes with exact ground truth, in batched torch: one code, any device."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from vergence_models.data.clips import StereoClips
from vergence_models.data.render import render
from vergence_models.data.shots import Mix, Playback, draw_shot
from vergence_models.data.textures import TextureBank
from vergence_models.data.truth import SurfaceTruth, surface_truth
from vergence_models.data.views import Shot


@dataclass(frozen=True, slots=True)
class GeneratorConfig:
    """The settings of a generator; everything else about a clip is drawn from its seed."""

    width: int = 256
    height: int = 192
    frames: int = 4
    rate_hz: float = 30.0
    largest_zoom: float = 1.0  # clips are windows of a camera image up to so many times as large
    mix: Mix | None = None  # shares of the kinds of scene; None: those of training
    playback: Playback | None = None  # the camera's speed; None: a random speed for each clip
    textures: Path | None = None  # a folder of photographs; None: procedural textures only
    bank_seed: int = 0
    texture_size: int = 256


class ClipGenerator:
    """Renders clean clips; a seed and an index always give the same clip."""

    def __init__(self, config: GeneratorConfig, *, device: torch.device | str = "cpu") -> None:
        self.config = config
        self.device = torch.device(device)
        self.bank = TextureBank.create(
            seed=config.bank_seed,
            photos=config.textures,
            size=config.texture_size,
            device=device,
        )

    def clips(self, *, seed: int, indices: Sequence[int]) -> StereoClips:
        """Clean clips number `indices` of the endless series that belongs to a seed."""
        c = self.config
        shots = self._shots(seed, indices)
        return render(shots, self.bank, width=c.width, height=c.height, device=self.device)

    def truth(self, *, seed: int, indices: Sequence[int]) -> SurfaceTruth:
        """Normals, flow and the change of disparity for the same clips."""
        c = self.config
        shots = self._shots(seed, indices)
        return surface_truth(shots, width=c.width, height=c.height, device=self.device)

    def _shots(self, seed: int, indices: Sequence[int]) -> list[Shot]:
        return [self._shot(np.random.default_rng((seed, index))) for index in indices]

    def _shot(self, rng: np.random.Generator) -> Shot:
        c = self.config
        zoom = np.exp(rng.uniform(0, np.log(c.largest_zoom))) if c.largest_zoom > 1 else 1.0
        width, height = round(c.width * zoom), round(c.height * zoom)
        shot = draw_shot(
            rng,
            self.bank.kinds,
            width=width,
            height=height,
            frames=c.frames,
            rate_hz=c.rate_hz,
            mix=c.mix,
            playback=c.playback,
        )
        x, y = (int(rng.integers(spare + 1)) for spare in (width - c.width, height - c.height))
        return replace(shot, cx=shot.cx - x, cy=shot.cy - y)
