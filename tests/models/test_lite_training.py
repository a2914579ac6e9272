"""Laws of what only `lite` is trained with, and of what its parts are worth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.support.wall_clips import wall_clips
from vergence_models.data.generator import ClipGenerator, GeneratorConfig
from vergence_models.data.pool import ClipPool, write_shard
from vergence_models.networks.lite.hypotheses import Hypotheses
from vergence_models.studies.parts import PARTS, main, table_of_parts
from vergence_models.studies.tables import read_tables
from vergence_models.training.trainer import Window, cutmix_state

RUN = Path(__file__).parents[2] / "models" / "runs" / "lite"


def test_a_clip_that_is_too_short_is_played_to_and_fro(tmp_path: Path) -> None:
    clips = wall_clips(1, frames=4)
    write_shard(tmp_path / "shard_1_000000", clips)
    position = clips.world_from_left[0, :, 0, 3]
    sampled = ClipPool(tmp_path).sample(np.random.default_rng(0), 1, frames=9)
    shown = sampled.world_from_left[0, :, 0, 3]
    order = (shown[:, None] - position).abs().argmin(dim=1)
    assert torch.equal(position[order], shown)
    assert set(order.tolist()) == {0, 1, 2, 3}
    assert (order.diff().abs() == 1).all()


@given(st.integers(0, 2**32))
def test_cutmix_replaces_one_window_of_a_state_and_nothing_else(seed: int) -> None:
    state = tuple(torch.randn(2, channels, 24, 32) for channels in (1, 5))
    window = Window.draw(np.random.default_rng(seed))
    for own, mixed in zip(state, cutmix_state(state, window), strict=True):
        replaced = (mixed != own).all(dim=1)
        assert torch.equal(mixed, torch.where(replaced[:, None], own.flip(0), own))
        rows, columns = replaced[0].any(dim=1), replaced[0].any(dim=0)
        assert torch.equal(replaced[0], rows[:, None] & columns)
        for edges in (rows, columns):
            assert edges.int().diff().abs().sum() <= 2


@pytest.mark.parametrize("scale", [4, 8])
def test_likelihood_teaches_the_choice_alone_and_hears_what_was_ruled_out(scale: int) -> None:
    truth = torch.full((1, 16, 16), 20.0)
    cells = 16 // scale
    surfaces = torch.tensor([20.0, 60.0]).view(1, 2, 1, 1).repeat(1, 1, cells, cells)
    scores = torch.tensor([-30.0, 0.0]).view(1, 2, 1, 1).repeat(1, 1, cells, cells)
    hypotheses = Hypotheses(surfaces.requires_grad_(), scores.requires_grad_())
    hypotheses.unlikelihood(truth, 192, scale=scale).backward()  # type: ignore[no-untyped-call]
    assert surfaces.grad is None
    assert scores.grad is not None
    towards = -scores.grad.sum(dim=(0, 2, 3))
    # The mean's own gradient would be e^-30 of this.
    assert towards.tolist() == pytest.approx([1.0, -1.0], abs=1e-3)


def test_likelihood_counts_known_truth_alone() -> None:
    surfaces, scores = torch.rand(2, 1, 3, 4, 4).mul(50)
    truth = torch.zeros(1, 16, 16)
    assert Hypotheses(surfaces, scores).unlikelihood(truth, 192, scale=4) == 0
    assert Hypotheses(surfaces, scores).unlikelihood(truth + 9, 192, scale=4) > 0


@pytest.mark.slow
def test_each_part_is_measured_beside_the_whole(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # A scene with edges: on a wall the first guess is as good as any other.
    config = GeneratorConfig(width=192, height=128, frames=2, texture_size=64)
    clips = ClipGenerator(config).clips(seed=3, indices=[0])
    write_shard(tmp_path / "pool" / "shard_1_000000", clips)
    arguments = ["--run", str(RUN), "--val", str(tmp_path / "pool"), "--clips", "1"]
    main([*arguments, "--json", str(tmp_path / "out" / "parts.json")])
    assert "What each part of lite is worth" in capsys.readouterr().out
    table = read_tables(tmp_path / "out" / "parts.json")["parts"]
    whole, *others = table.rows
    assert table.labels == list(PARTS)
    # Silencing one part is undone before the next, and each one is heard.
    again = table_of_parts(RUN, ClipPool(tmp_path / "pool"), clips=1).rows[0]
    assert again == whole
    assert all(row.values != whole.values for row in others)


def test_parts_of_another_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match=f"{tmp_path}"):
        main(["--run", str(tmp_path), "--val", str(tmp_path), "--json", str(tmp_path / "p.json")])
