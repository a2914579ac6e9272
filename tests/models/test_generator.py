"""Laws of the synthetic stereo video as it comes: determinism, the eyes, the sensor."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.support.tiny_scenes import SMALL
from vergence_models.data.clips import StereoClips
from vergence_models.data.generator import ClipGenerator
from vergence_models.data.sensor import SensorConfig, film_as_sensor
from vergence_models.data.textures import TextureBank


def sampled_at(image: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Bilinear lookups in images [N, C, H, W] at pixel positions [N, H, W]."""
    height, width = image.shape[-2:]
    grid = torch.stack([u / (width - 1), v / (height - 1)], -1) * 2 - 1
    return torch.nn.functional.grid_sample(image, grid, align_corners=True)


def test_the_right_image_moved_by_the_disparity_is_the_left_image(clips: StereoClips) -> None:
    left, right = (
        eye.flatten(0, 1).permute(0, 3, 1, 2).float() for eye in (clips.left, clips.right)
    )
    disparity, visible = clips.disparity_px.flatten(0, 1), clips.visible.flatten(0, 1)
    v, u = torch.meshgrid(torch.arange(96.0), torch.arange(128.0), indexing="ij")

    def difference(wrong_px: float) -> float:
        moved = sampled_at(right, u - disparity - wrong_px, v.expand_as(disparity))
        return float((moved - left).abs().mean(1)[visible].mean())

    # Gloss, mirrors and the edges between pixels stay; everything else must agree.
    assert difference(0) < 0.6 * min(difference(-1), difference(1))
    assert difference(0) < 0.35 * min(difference(-4), difference(4))


def test_a_clip_is_the_same_alone_and_in_company(
    generator: ClipGenerator, clips: StereoClips
) -> None:
    alone = ClipGenerator(SMALL).clips(seed=5, indices=[3])
    for name in StereoClips.__slots__:
        assert torch.equal(getattr(alone, name), getattr(clips[3:4], name)), name
    other = generator.clips(seed=6, indices=[3])
    assert not torch.equal(other.left, alone.left)


def test_disparities_are_positive_and_visible_points_have_a_match(clips: StereoClips) -> None:
    assert (clips.disparity_px >= 0).all()
    assert (clips.disparity_px > 0).float().mean() > 0.9
    u = torch.arange(128.0) - clips.disparity_px
    assert (u[clips.visible] >= 0).all()
    assert 0.5 < clips.visible.float().mean() < 0.99


def test_the_sensor_leaves_the_truth_alone_and_follows_its_seed(clips: StereoClips) -> None:
    recorded = film_as_sensor(clips, np.random.default_rng(1))
    again = film_as_sensor(clips, np.random.default_rng(1))
    for name in StereoClips.__slots__:
        untouched = name not in {"left", "right"}
        assert torch.equal(getattr(recorded, name), getattr(clips, name)) == untouched, name
        assert torch.equal(getattr(recorded, name), getattr(again, name)), name


def test_a_perfect_sensor_changes_nothing(clips: StereoClips) -> None:
    perfect = SensorConfig(
        noise=0, tone=0, mismatch=0, flicker=0, vignetting=0, defocus=0, motion_blur=0,
        misalignment=0, jpeg=0, grey=0,
    )  # fmt: skip
    recorded = film_as_sensor(clips, np.random.default_rng(1), perfect)
    assert torch.equal(recorded.left, clips.left)
    assert torch.equal(recorded.right, clips.right)


def test_a_folder_without_photographs_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=tmp_path.name):
        TextureBank.create(seed=0, photos=tmp_path)
