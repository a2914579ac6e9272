"""The coarse search at 1/8: every disparity, four pixels apart, and iterations on its scores."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vergence_models.config import LiteNetworkConfig
from vergence_models.networks.cost_volume import Volume, gathered, lookup, lookup_row
from vergence_models.networks.layers import (
    GatedCell,
    best_rival,
    box3,
    conv,
    enlarge,
    silent,
    squash,
)
from vergence_models.networks.lite.hypotheses import Hypotheses
from vergence_models.networks.warp import cell_centres

BIN_PX = 4  # spacing of the coarse disparities
REACH = 2  # entries looked up on either side of the current disparity
TAPS = 2 * REACH + 1
FILLS = 3  # surfaces that the surroundings suggest: the smooth, the farthest, the nearest one
HYPOTHESES = 2 + FILLS  # with the current disparity and the best of the scores
CELL_INPUTS = TAPS + 2 * FILLS + 5  # inputs of the cell besides the context
MIN_PX = 0.1  # the smallest disparity of a result


class CostFeatures(NamedTuple):
    """The inputs of the cost filter that depend on the two images alone."""

    fixed: Tensor  # [B, D, H, W] at 1/8, largest disparity first: scores before anything learned
    features: Tensor  # [B D, C, H/2, W/2]: input of the learned filter


class CostFilter(nn.Module):
    """Coarse scores from the raw volume.

    A score is the sum of box windows of three sizes, a penalty on matches that another surface
    claims too, and a learned residual.

    The residual is the same small network for every disparity (folded into the batch). Its inputs
    include the image's context and the previous frame's surface. What it learns at one disparity
    holds at all of them.
    """

    def __init__(self, config: LiteNetworkConfig) -> None:
        super().__init__()
        width = config.cost_channels
        self.sharpness = nn.Parameter(torch.tensor([6.0, 8.0, 10.0]))
        self.mutual = nn.Parameter(torch.tensor(0.3))
        self.enter = conv(4, width, kernel=2, stride=2)
        self.expected = conv(4, width, kernel=1)
        self.context = conv(config.context_low, width, kernel=1)
        self.down = conv(width, width, stride=2)
        self.low = conv(width, width)
        self.middle = conv(width, width, kernel=1)
        self.leave = silent(conv(width, 4, kernel=1))

    def cost_features(self, volume: Tensor) -> CostFeatures:
        """``volume`` [B, H, W, D] at 1/8."""
        batch, height, width, bins = volume.shape
        narrow = volume.permute(0, 3, 1, 2)
        middle = box3(narrow)
        wide = box3(box3(middle))
        fixed = narrow * self.sharpness[0] + middle * self.sharpness[1] + wide * self.sharpness[2]
        lead = (fixed - fixed.amax(dim=1, keepdim=True)) * 0.1
        claim = (fixed - best_rival(fixed, 2)).clamp(max=0) * 0.1
        channels = (narrow, middle, lead.clamp(min=-1), claim.clamp(min=-1))
        stacked = torch.stack(channels, dim=2)
        features = self.enter(stacked.reshape(batch * bins, len(channels), height, width))
        return CostFeatures(fixed + 10 * self.mutual * claim, features)

    def forward(self, cost_features: CostFeatures, context: Tensor, prior: Tensor) -> Tensor:
        """Scores [B, H, W, D]; ``context`` [B, C, H/2, W/2], ``prior`` [B, 1, H, W] px or 0."""
        batch, bins, height, width = cost_features.fixed.shape
        # Where nothing is expected, nothing is near.
        expected_px = F.pixel_unshuffle(prior - (prior <= 0).to(prior.dtype) * 1e3, 2)
        bin_px = torch.arange(bins - 1, -1, -1, device=prior.device).to(prior.dtype) * BIN_PX
        apart_px = expected_px.reshape(batch, 1, -1) - bin_px[:, None]
        near = (1 - apart_px.abs() * (0.5 / BIN_PX)).clamp(min=0)
        x = cost_features.features + self.expected(near.view(-1, 4, height // 2, width // 2))
        x = x.view(batch, bins, -1, height // 2, width // 2) + context[:, None]
        x = F.relu6(x).view(batch * bins, -1, height // 2, width // 2)
        low = F.relu6(self.low(F.relu6(self.down(x))))
        x = F.relu6(self.middle(x + enlarge(low)))
        residual = F.pixel_shuffle(self.leave(x), 2).view(batch, bins, height, width)
        return (cost_features.fixed + residual).permute(0, 2, 3, 1)


def coarse_position(d: Tensor, last: int) -> Tensor:
    """The index of disparity ``d`` px among the coarse scores; the last one is that of 0 px."""
    return last - d * (1 / BIN_PX)


def peak(volume: Volume) -> tuple[Tensor, Tensor]:
    """Disparity px and log-probability of the best window of five bins, each [B, 1, H, W]."""
    scores = volume.scores
    bins = scores.shape[-1]
    best = scores.argmax(dim=-1)[:, None].clamp(2, bins - 3).to(scores.dtype)
    offsets = torch.arange(-2, 3, device=scores.device).to(scores.dtype)[:, None, None]
    window = gathered(volume, best + offsets)
    top = window.amax(dim=1, keepdim=True)
    weights = torch.exp(window - top)
    mass = weights.sum(dim=1, keepdim=True)
    total = torch.exp(scores - top[:, 0, :, :, None]).sum(dim=-1)[:, None]
    centre = (weights * offsets).sum(dim=1, keepdim=True) / mass
    return (bins - 1 - best - centre) * BIN_PX, torch.log(mass / total)


def smooth_fill(d: Tensor, confidence: Tensor) -> Tensor:
    """Fill from confident cells: a pull-push pyramid of confidence-weighted means, [B, 1, H, W].

    A confident cell is averaged with its neighbours; a cell on a blank wall takes the wall's rim.
    """
    weight = confidence + 1e-4
    both = torch.cat((d * weight, weight), dim=1)
    half = F.avg_pool2d(both, 2)
    quarter = F.avg_pool2d(half, 2)
    wide = box3(quarter)
    wide = wide + 0.1 * box3(box3(wide))
    half = box3(half) + 0.1 * F.interpolate(wide, scale_factor=2.0, mode="bilinear")
    total = box3(both) + 0.1 * F.interpolate(half, scale_factor=2.0, mode="bilinear")
    return total[:, :1] / total[:, 1:]


def extremes(d: Tensor, confidence: Tensor, otherwise: Tensor) -> Tensor:
    """The farthest and the nearest surface among confident neighbours, [B, 2, H, W].

    An occluded cell shows the farthest; a blank or thin object is part of the nearest. The window
    extends mostly along the row. Without a confident neighbour the result is ``otherwise``.
    """
    doubt = 1e3 * (confidence < 0.5).to(d.dtype)
    both = torch.cat((-d - doubt, d - doubt), dim=1)
    beside = F.max_pool2d(both, (3, 9), stride=1, padding=(1, 4))
    wide = F.max_pool2d(beside, (3, 9), stride=1, padding=(1, 4))
    # A disparity is below 500 px, and what is doubtful above it.
    found = torch.where(beside > -500, beside, wide)
    signed = torch.cat((-found[:, :1], found[:, 1:]), dim=1)
    return torch.where(found > -500, signed, otherwise)


def beyond(d: Tensor, *, scale: int) -> Tensor:
    """The distance of the match beyond the left border of the right image, in cells, -1 to 1.

    ``d`` [B, K, H, W] px at 1/``scale``. Nothing can match there: an apparent match is noise.
    """
    u, _ = cell_centres(d.shape[2], d.shape[3], scale, d)
    return ((d - u) * (1 / scale)).clamp(-1, 1)


class CoarseUpdate(nn.Module):
    """One iteration at 1/8: read the scores around the current disparity, choose, correct."""

    def __init__(self, config: LiteNetworkConfig) -> None:
        super().__init__()
        self.cell = GatedCell(config.hidden, 64 - config.hidden, kernel=1)
        self.head = conv(config.hidden, config.hidden, kernel=1)
        self.out = silent(conv(config.hidden, HYPOTHESES + 1, kernel=1))

    def forward(
        self,
        hidden: Tensor,
        d: Tensor,
        *,
        peak: tuple[Tensor, Tensor],
        fills: Tensor,
        hole: Tensor,
        scores: Volume,
        context: Tensor,
    ) -> tuple[Tensor, Tensor, Hypotheses]:
        """Return the next hidden state, the next disparity [B, 1, H, W] px, and the hypotheses."""
        peak_px, peak_log = peak
        top = scores.scores.amax(dim=-1)[:, None]
        around = lookup_row(scores, coarse_position(d, scores.last), REACH)
        at_fills = lookup(scores, coarse_position(fills, scores.last))
        log_p = (torch.cat((around, at_fills), dim=1) - top).clamp(-20, 0)
        inputs = torch.cat(
            (
                context,
                log_p * 0.1,
                peak_log,
                squash(torch.cat((peak_px, fills), dim=1) - d, 2.0),
                hole,
                d * (1 / 64),
                beyond(d, scale=8),
            ),
            dim=1,
        )
        hidden = self.cell(hidden, inputs)
        learned = self.out(F.relu(self.head(hidden)))
        # The fixed part of the choice is the score, and a penalty on peaks that are not unique.
        kept, at_fills = log_p[:, REACH : REACH + 1], log_p[:, TAPS:]
        fixed = torch.cat((kept + 1, 2 * peak_log, at_fills - 1), dim=1)
        surfaces = torch.cat((d, peak_px, fills), dim=1)
        hypotheses = Hypotheses(surfaces, fixed + 4 * learned[:, :HYPOTHESES])
        d = (hypotheses.mean() + 4 * learned[:, HYPOTHESES:]).clamp(min=MIN_PX)
        return hidden, d, hypotheses
