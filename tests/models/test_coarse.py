"""Laws of the wide search's reading of its scores."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from vergence_models.lite.coarse import BIN_PX, PEAK_APART, peaks
from vergence_models.volume import whole_rows

BINS = 48
INNER = st.integers(2, BINS - 3)  # a window of five bins fits


def scores_with_peaks(heights: dict[int, float]) -> torch.Tensor:
    """One cell, [1, 1, 1, BINS]: zero but at bins of these disparities."""
    scores = torch.zeros(1, 1, 1, BINS)
    for disparity, height in heights.items():
        scores[..., BINS - 1 - disparity] = height
    return scores


@given(first=INNER, second=INNER)
def test_both_peaks_are_found_where_they_are(first: int, second: int) -> None:
    if abs(first - second) < PEAK_APART + 2:
        second = first - 10 if first > BINS // 2 else first + 10
    px, log_share = peaks(whole_rows(scores_with_peaks({first: 30.0, second: 25.0})))
    torch.testing.assert_close(px.flatten(), torch.tensor([first, second]) * float(BIN_PX))
    assert log_share[0, 0] > -0.02  # nearly all of it
    torch.testing.assert_close(log_share[0, 1].item(), -5.0, atol=0.02, rtol=0)
