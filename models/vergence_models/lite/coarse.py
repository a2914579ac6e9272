"""The coarse search at 1/8: every disparity, four pixels apart, and iterations on its scores."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vergence_models.config import LiteNetworkConfig
from vergence_models.layers import (
    GatedCell,
    best_rival,
    box3,
    conv,
    enlarge,
    silent,
    squash,
)
from vergence_models.lite.hypotheses import Hypotheses
from vergence_models.volume import Volume, gathered, lookup, lookup_row
from vergence_models.warp import cell_centres

BIN_PX = 4  # spacing of the coarse disparities
REACH = 2  # entries looked up on either side of the current disparity
TAPS = 2 * REACH + 1
PEAKS = 2  # of the scores
AROUND = 5  # what surroundings suggest: the smooth, farthest, nearest surface, the current rims
HYPOTHESES = 1 + PEAKS + AROUND  # with the current disparity
CELL_INPUTS = TAPS + 2 * (PEAKS + AROUND) + 3  # what the cell sees besides the context
CELL = 72  # channels of the cell: its state, what it sees, and the context in what is left
PEAK_APART = 4  # bins between the best of the scores and the second
MIN_PX = 0.1  # no answer is nearer to infinity


class Clues(NamedTuple):
    """What the scores of the wide search are made of, as far as two images alone say it."""

    fixed: Tensor  # [B, D, H, W] at 1/8, largest disparity first: scores before anything learned
    features: Tensor  # [B D, C, H/2, W/2]: what the learned filter sees of them


class CostFilter(nn.Module):
    """Coarse scores from the raw volume.

    Box windows of three sizes, a doubt about matches that another surface claims too, and a learned
    residual.

    The residual is the same small network for every disparity (folded into the batch), told what
    the image looks like and where the previous frame's surface lies: what it learns at one
    disparity holds at all of them.
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

    def clues(self, volume: Tensor) -> Clues:
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
        return Clues(fixed + 10 * self.mutual * claim, features)

    def forward(self, clues: Clues, context: Tensor, prior: Tensor) -> Tensor:
        """Scores [B, H, W, D]; ``context`` [B, C, H/2, W/2], ``prior`` [B, 1, H, W] px or 0."""
        batch, bins, height, width = clues.fixed.shape
        # Where nothing is expected, nothing is near.
        expected_px = F.pixel_unshuffle(prior - (prior <= 0).to(prior.dtype) * 1e3, 2)
        bin_px = torch.arange(bins - 1, -1, -1, device=prior.device).to(prior.dtype) * BIN_PX
        apart_px = expected_px.reshape(batch, 1, -1) - bin_px[:, None]
        near = (1 - apart_px.abs() * (0.5 / BIN_PX)).clamp(min=0)
        x = clues.features + self.expected(near.view(-1, 4, height // 2, width // 2))
        x = x.view(batch, bins, -1, height // 2, width // 2) + context[:, None]
        x = F.relu6(x).view(batch * bins, -1, height // 2, width // 2)
        low = F.relu6(self.low(F.relu6(self.down(x))))
        x = F.relu6(self.middle(x + enlarge(low)))
        residual = F.pixel_shuffle(self.leave(x), 2).view(batch, bins, height, width)
        return (clues.fixed + residual).permute(0, 2, 3, 1)


def coarse_position(d: Tensor, last: int) -> Tensor:
    """Where disparity ``d`` px lies among the coarse scores, the last of which is that of 0 px."""
    return last - d * (1 / BIN_PX)


def peaks(volume: Volume) -> tuple[Tensor, Tensor]:
    """The best window of five bins and the best one apart from it: px and log-probability.

    Each [B, 2, H, W]. A thin thing in front of a pattern is often the second.
    """
    scores = volume.scores
    last = scores.shape[-1] - 1
    best = scores.argmax(dim=-1, keepdim=True).to(scores.dtype)
    # Few cheap operations: a parabola is far below the scores where bins are near, above elsewhere.
    steps = torch.arange(last + 1, device=scores.device).to(scores.dtype) * 100 - best * 100
    apart = steps * steps - 1e4 * (PEAK_APART - 0.5) ** 2
    second = torch.minimum(scores, apart).argmax(dim=-1, keepdim=True).to(scores.dtype)
    at = torch.cat((best, second), dim=-1).permute(0, 3, 1, 2).clamp(2, last - 2)
    offsets = torch.arange(-2, 3, device=scores.device).to(scores.dtype)
    entries = at[:, :, None] + offsets[:, None, None]
    window = gathered(volume, entries.flatten(1, 2)).view(entries.shape)
    top = scores.amax(dim=-1)[:, None]
    weights = torch.exp(window - top[:, None])
    mass = weights.sum(dim=2)
    total = torch.exp(scores - top[:, 0, :, :, None]).sum(dim=-1)[:, None]
    centre = (weights * offsets[:, None, None]).sum(dim=2) / (mass + 1e-12)
    return (last - at - centre) * BIN_PX, torch.log((mass / total).clamp(min=1e-6))


def smooth_fill(d: Tensor, confidence: Tensor) -> Tensor:
    """What confident surroundings say: a pull-push pyramid of confidence-weighted means. [B,1,H,W].

    Where a cell is confident it hears itself and its neighbours; on a blank wall, the wall's rim.
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

    The farthest is what an occluded cell shows, the nearest what a blank or thin thing is part of.
    Mostly along the row; ``otherwise`` where no neighbour is confident.
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
    """How many cells the match lies beyond the left border of the right image, -1 to 1.

    ``d`` [B, K, H, W] px at 1/``scale``. Nothing can match there: what looks like it is noise.
    """
    u, _ = cell_centres(d.shape[2], d.shape[3], scale, d)
    return ((d - u) * (1 / scale)).clamp(-1, 1)


def rims(d: Tensor) -> Tensor:
    """The largest and the smallest disparity of 3x3 cells: [B, 1, H, W] to [B, 2, H, W]."""
    return torch.cat((F.max_pool2d(d, 3, 1, 1), -F.max_pool2d(-d, 3, 1, 1)), dim=1)


class CoarseUpdate(nn.Module):
    """One iteration at 1/8: look at the scores round the current disparity, choose, correct."""

    def __init__(self, config: LiteNetworkConfig) -> None:
        super().__init__()
        self.cell = GatedCell(config.hidden, CELL - config.hidden, kernel=1)
        self.head = conv(config.hidden, config.hidden, kernel=1)
        self.out = silent(conv(config.hidden, HYPOTHESES + 1, kernel=1))

    def forward(
        self,
        hidden: Tensor,
        d: Tensor,
        *,
        guess: tuple[Tensor, Tensor],
        around: Tensor,
        hole: Tensor,
        scores: Volume,
        context: Tensor,
    ) -> tuple[Tensor, Tensor, Hypotheses]:
        """Hidden state and disparity [B, 1, H, W] px to the next ones; what was chosen among.

        ``guess`` are the peaks of the scores, ``around`` what the surroundings suggest.
        """
        guess_px, guess_log = guess
        top = scores.scores.amax(dim=-1)[:, None]
        beside = lookup_row(scores, coarse_position(d, scores.last), REACH)
        at_around = lookup(scores, coarse_position(around, scores.last))
        log_p = (torch.cat((beside, at_around), dim=1) - top).clamp(-20, 0)
        suggested = torch.cat((guess_px, around), dim=1)
        inputs = torch.cat(
            (
                context,
                log_p * 0.1,
                guess_log,
                squash(suggested - d, 2.0),
                hole,
                d * (1 / 64),
                beyond(d, scale=8),
            ),
            dim=1,
        )
        hidden = self.cell(hidden, inputs)
        learned = self.out(F.relu(self.head(hidden)))
        # Fixed part of the choice: the score itself, and a doubt about guesses that are not unique.
        kept, at_around = log_p[:, REACH : REACH + 1], log_p[:, TAPS:]
        fixed = torch.cat((kept + 1, 2 * guess_log, at_around - 1), dim=1)
        surfaces = torch.cat((d, suggested), dim=1)
        hypotheses = Hypotheses(surfaces, fixed + 4 * learned[:, :HYPOTHESES])
        d = (hypotheses.mean() + 4 * learned[:, HYPOTHESES:]).clamp(min=MIN_PX)
        return hidden, d, hypotheses
