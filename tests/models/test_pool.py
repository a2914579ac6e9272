"""Laws of stored clips: they come back, whole, and their geometry survives sampling."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from tests.support.tiny_scenes import agreement, furnished_room
from vergence_models.data import pool
from vergence_models.data.clips import StereoClips
from vergence_models.data.generator import ClipGenerator, GeneratorConfig
from vergence_models.data.pool import ClipPool, write_shard


def test_a_pool_gives_back_what_was_written(tmp_path: Path, clips: StereoClips) -> None:
    write_shard(tmp_path / "shard_0_000000", clips[:3])
    write_shard(tmp_path / "shard_0_000003", clips[3:])
    stored = ClipPool(tmp_path)
    assert len(stored) == 8
    back = stored.clips(range(8))
    for name in StereoClips.__slots__:
        if name != "disparity_px":
            assert torch.equal(getattr(back, name), getattr(clips, name)), name
    step_px = 1 / pool.DISPARITY_SCALE
    assert (back.disparity_px - clips.disparity_px).abs().max() <= step_px / 2


def test_a_pool_sees_only_whole_shards_of_its_size(tmp_path: Path, clips: StereoClips) -> None:
    write_shard(tmp_path / "shard_0_000000", clips[:2])
    (tmp_path / "shard_0_000002.partial").mkdir()
    stored = ClipPool(tmp_path, size=(128, 96))
    assert len(stored) == 2
    write_shard(tmp_path / "shard_0_000002", clips[2:4])
    stored.refresh()
    assert len(stored) == 4
    with pytest.raises(FileNotFoundError, match="64x64"):
        ClipPool(tmp_path, size=(64, 64))


def test_windows_flips_and_reversal_keep_the_geometry(
    tmp_path: Path, generator: ClipGenerator
) -> None:
    write_shard(tmp_path / "shard_0_000000", furnished_room(generator.bank))
    rng = np.random.default_rng(0)
    stored = ClipPool(tmp_path)
    for chances in ({"reverse": 1.0}, {"flip": 1.0}, {"skip": 1.0}):
        batch = stored.sample(rng, 1, frames=2, crop=(96, 80), **chances)
        assert batch.left.shape == (1, 2, 80, 96, 3)
        assert agreement(batch, 0) > 0.93, chances


def test_a_stopped_pool_goes_on_where_it_was(tmp_path: Path) -> None:
    config = GeneratorConfig(width=48, height=32, frames=2, texture_size=32)

    def rendered(clips: int) -> int:
        return pool.render_pool(tmp_path, config, clips=clips, seed=1, shard_clips=2, workers=1)

    assert rendered(2) == 2
    assert rendered(4) == 2
    assert rendered(4) == 0
    assert len(ClipPool(tmp_path)) == 4
