"""Sigma by what the two images show: the ambiguity of the match and the refinement's estimate.

The refinement estimates its own error from learned features, so it trusts what looks like its
training. The matching scores of the present pair show whether the disparity can be seen at all:
how far the disparities that match about as well lie from the answer, how much better the best of
them matches than the mean, and the same of the surroundings. X. Hu and P. Mordohai compare such
measures in "A Quantitative Evaluation of Confidence Measures for Stereo Vision" (PAMI 2012).

Nothing remembered enters, so a stream that sees nothing any more is unsure in the same frame. And
nothing here returns to the disparity or the state: weights of this part can change by themselves.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vergence_models.networks.layers import box3, conv, enlarge, silent
from vergence_models.networks.lite.coarse import BIN_PX, beyond

NEAR_PX = 6.0  # a match this close to the answer is the same match
SOFT = 0.25  # scores are compared twice: as they are, and so much more tolerant
FEATURES = 12
HIDDEN = 16
GAIN_LOG = 3.0  # bounds of the logarithms of both results
FLOOR_LOG = (-6.0, 4.6)


def ambiguity(sigma: Tensor, disparity: Tensor, scores: Tensor) -> Tensor:
    """Measures of how well the images show the disparity, [B, FEATURES, H/8, W/8].

    ``sigma`` [B, H, W] px, of the refinement; ``disparity`` [B, 1, H/4, W/4] px, the answer;
    ``scores`` [B, D, H/8, W/8] before anything learned, largest disparity first.
    """
    answer = F.avg_pool2d(disparity, 2)
    bins = scores.shape[1]
    bin_px = torch.arange(bins - 1, -1, -1, device=scores.device).to(scores.dtype) * BIN_PX
    apart = (bin_px[:, None, None] - answer).abs()
    beside = (apart - NEAR_PX).clamp(min=0)
    top = scores.amax(dim=1, keepdim=True)
    soft = torch.exp((scores - top) * SOFT)
    sharp = soft * soft
    sharp = sharp * sharp
    spreads = [
        torch.log1p((share * beside).sum(dim=1, keepdim=True) / share.sum(dim=1, keepdim=True))
        for share in (soft, sharp)
    ]
    near = (apart <= NEAR_PX).to(scores.dtype) * 1e3
    own = (scores + near).amax(dim=1, keepdim=True) - 1e3
    rival = (scores - near).amax(dim=1, keepdim=True)
    # A score that all disparities share, as of an even slope of brightness, is no evidence.
    best = (top - scores.mean(dim=1, keepdim=True)) * 0.1
    shown = torch.cat((spreads[1], best), dim=1)
    around = box3(box3(shown))
    far = box3(box3(F.avg_pool2d(shown, 4)))
    return torch.cat(
        (
            *spreads,
            best,
            ((top - own) * 0.1).clamp(max=4),
            ((own - rival) * 0.1).clamp(-2, 2),
            beyond(answer, scale=8),
            answer * (1 / 64),
            torch.log(F.avg_pool2d(sigma[:, None, ::4, ::4], 2)),
            around,
            enlarge(enlarge(far)),
        ),
        dim=1,
    )


class SigmaHead(nn.Module):
    """Sigma of the result: a gain times the refinement's sigma, plus a floor, for cells of 1/8.

    Both come from :func:`ambiguity` by two small layers, in float32 also where all else is int8.
    Untrained, it returns the refinement's sigma.
    """

    def __init__(self) -> None:
        super().__init__()
        self.enter = conv(FEATURES, HIDDEN, kernel=1)
        self.leave = silent(conv(HIDDEN, 2, kernel=1))
        with torch.no_grad():
            assert self.leave.bias is not None
            self.leave.bias[1] = FLOOR_LOG[0]

    def forward(self, sigma: Tensor, disparity: Tensor, scores: Tensor) -> Tensor:
        """Sigma px [B, H, W]; the arguments are those of :func:`ambiguity`."""
        # What it learns must not change what it judges.
        measures = ambiguity(sigma, disparity.detach(), scores.detach())
        return applied(sigma, self.factors(measures))

    def factors(self, measures: Tensor) -> Tensor:
        """Gain, and floor in px: [B, 2, H/8, W/8]."""
        found = self.leave(F.relu(self.enter(measures)))
        gain = found[:, :1].clamp(-GAIN_LOG, GAIN_LOG)
        return torch.exp(torch.cat((gain, found[:, 1:].clamp(*FLOOR_LOG)), dim=1))


def applied(sigma: Tensor, factors: Tensor) -> Tensor:
    """Gain and floor of cells of 1/8 on sigma [B, H, W]."""
    batch, height, width = sigma.shape
    rows = factors[..., None].expand(-1, -1, -1, -1, 8).flatten(3)
    planes = rows[:, :, :, None].expand(-1, -1, -1, 8, -1).reshape(batch, 2, height, width)
    return sigma * planes[:, 0] + planes[:, 1]
