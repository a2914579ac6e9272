"""Augmentation of clips: windows enlarged to larger disparities, and flawed cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from vergence_models.data.clips import StereoClips
from vergence_models.data.sensor import film_as_sensor

MAX_STRETCH = 4.0


def stretched(clips: StereoClips, random: np.random.Generator, *, share: float) -> StereoClips:
    """Each clip, with probability ``share``, as a window of it enlarged to the whole size.

    Rows grow by up to :data:`MAX_STRETCH` and columns by less, so disparity grows with the rows;
    poses stay true because the camera matrix follows.
    """
    singles = [clips[index : index + 1] for index in range(len(clips))]
    return StereoClips.concatenate(
        [_stretched(one, random) if random.random() < share else one for one in singles]
    )


def filmed(clips: StereoClips, random: np.random.Generator, *, clean_share: float) -> StereoClips:
    """Each clip as flawed cameras record it, or, with chance ``clean_share``, as it is."""
    singles = [clips[index : index + 1] for index in range(len(clips))]
    return StereoClips.concatenate(
        [one if random.random() < clean_share else film_as_sensor(one, random) for one in singles]
    )


def _stretched(clip: StereoClips, random: np.random.Generator) -> StereoClips:
    height, width = clip.disparity_px.shape[-2:]
    window_width = int(width / random.uniform(1, MAX_STRETCH))
    window_height = int(height / random.uniform(1, max(1.0, width / window_width / 1.5)))
    x = int(random.integers(width - window_width + 1))
    y = int(random.integers(height - window_height + 1))
    across, down = width / window_width, height / window_height

    rows, columns = slice(y, y + window_height), slice(x, x + window_width)

    def grown(planes: Tensor) -> Tensor:
        cut = planes[0, :, None, rows, columns].float()
        return F.interpolate(cut, (height, width))[None, :, 0]

    def seen(images: Tensor) -> Tensor:
        cut = images[0, :, rows, columns].permute(0, 3, 1, 2).float().contiguous()
        large = F.interpolate(cut, (height, width), mode="bilinear", align_corners=False)
        return large.round().clamp(0, 255).to(torch.uint8).permute(0, 2, 3, 1)[None]

    return replace(
        clip,
        left=seen(clip.left),
        right=seen(clip.right),
        disparity_px=grown(clip.disparity_px) * across,
        visible=grown(clip.visible) > 0.5,
        fx=clip.fx * across,
        fy=clip.fy * down,
        cx=(clip.cx - x + 0.5) * across - 0.5,
        cy=(clip.cy - y + 0.5) * down - 0.5,
    )
