"""Laws of volumes: only near pairs, read between their entries."""

from __future__ import annotations

import pytest
import torch

from vergence_models.networks.cost_volume import (
    Near,
    Volume,
    gathered,
    lookup,
    lookup_row,
    whole_rows,
)
from vergence_models.networks.layers import all_pairs, conv, joint


@pytest.mark.parametrize("ratio", [1, 2])
def test_near_pairs_are_those_of_all_pairs_within_reach(ratio: int) -> None:
    reach, margin, width = 12, 3, 32
    left, right = torch.randn(2, 4, 6, width), torch.randn(2, 4, 6, ratio * width)
    columns, everything = Near(ratio, reach, margin), all_pairs(left, right)
    near = columns.volume(columns.pairs(left, right))
    x = torch.arange(width).expand(2, 1, 6, width)
    for offset in range(-reach - margin, margin + 1):
        entry = ratio * x + offset
        inside = (entry >= 0) & (entry < ratio * width)
        expected = everything.gather(3, entry.clamp(0, ratio * width - 1)[:, 0, :, :, None])
        difference = gathered(near, entry.float())[:, 0] - expected[..., 0]
        assert difference[inside[:, 0]].abs().max() < 1e-6


def squares(first: float = 0.0) -> Volume:
    """Of a row of eight squares, all of it or what is left of it from ``first`` on."""
    row = torch.arange(8.0)[int(first) :].view(1, 1, 1, -1) ** 2
    return Volume(row, torch.zeros(1), torch.tensor([first]), 1, row.shape[-1], 7)


@pytest.mark.parametrize("first", [0.0, 2.0])
def test_lookups_interpolate_and_are_zero_outside(first: float) -> None:
    at = torch.tensor([2.5, 6.25, -0.5, 7.5]).view(1, 4, 1, 1)
    assert lookup(squares(first), at).flatten().tolist() == pytest.approx([6.5, 39.25, 0.0, 0.0])
    row = lookup_row(squares(first), torch.full((1, 1, 1, 1), 3.5), 1)
    assert row.flatten().tolist() == pytest.approx([6.5, 12.5, 20.5])


def test_each_cell_reads_its_own_row() -> None:
    scores = torch.randn(2, 3, 4, 9)
    entry = torch.randint(0, 8, (2, 5, 3, 4))
    expected = scores.gather(3, entry.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)
    assert torch.equal(lookup(whole_rows(scores), entry.float()), expected)


def test_a_joint_convolution_is_that_of_the_concatenation() -> None:
    layer, parts = conv(9, 5, stride=2), [torch.randn(2, count, 8, 6) for count in (4, 3, 2)]
    expected = layer(torch.cat(parts, dim=1))
    assert torch.allclose(joint(layer, *parts), expected, atol=1e-5)
