"""The fine search at 1/4: a few hypotheses per cell, and the upsampling to full size."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vergence_models.config import LiteNetworkConfig
from vergence_models.networks.cost_volume import Near, Volume, lookup, lookup_row
from vergence_models.networks.layers import (
    ConvexUpsampler,
    box3,
    conv,
    enlarge,
    expected,
    joint,
    silent,
    squash,
)
from vergence_models.networks.lite.coarse import MIN_PX, beyond
from vergence_models.networks.lite.hypotheses import Hypotheses
from vergence_models.networks.warp import cell_centres

SURFACES = 3  # hypotheses of a cell
FINE_PX = 2  # spacing of the fine descriptors along the right row, and so of the disparities
REACH = 2  # entries looked up on either side of the current disparity
TAPS = 2 * REACH + 1


def near_columns(max_disparity_px: int) -> Near:
    """The columns of the right image that the fine search reads."""
    return Near(ratio=4 // FINE_PX, reach=max_disparity_px // FINE_PX, margin=REACH + 2)


def rims(d: Tensor) -> Tensor:
    """The largest and the smallest disparity of 3x3 cells: [B, 1, H, W] to [B, 2, H, W]."""
    return torch.cat((F.max_pool2d(d, 3, 1, 1), -F.max_pool2d(-d, 3, 1, 1)), dim=1)


class Refined(NamedTuple):
    """A disparity at 1/4, with the features that upsample it to full size."""

    disparity: Tensor  # [B, 1, H/4, W/4] px
    doubt: Tensor  # [B, 1, H/4, W/4]: a logarithm of sigma, up to scale and bounds
    features: Tensor  # [B, C, H/4, W/4]


class Refinement(nn.Module):
    """From 1/8 to full size: choose among nearby surfaces at 1/4, fit sub-pixel, upsample."""

    def __init__(self, config: LiteNetworkConfig) -> None:
        super().__init__()
        width = config.fine_channels
        self.hidden = conv(config.hidden, width, kernel=1)
        self.first = conv(config.context_quarter + 4 * SURFACES, width, kernel=1)
        self.down = conv(width, config.fine_low, stride=2)
        self.low = conv(config.fine_low, config.fine_low)
        self.lower = conv(config.fine_low, config.fine_low)
        self.back = silent(conv(config.fine_low, width, kernel=1))
        self.choose = silent(conv(width, SURFACES))
        self.second = conv(width + 2 * TAPS + 6, width)
        self.out = silent(conv(width, 3, kernel=1))
        self.upsample = ConvexUpsampler(width)
        self.sharpness = nn.Parameter(torch.tensor([6.0, 10.0]))
        self.subpixel = nn.Parameter(torch.tensor(12.0))

    def forward(
        self,
        pairs: Volume,
        d_eighth: Tensor,
        hidden: Tensor,
        prior: Tensor,
        context: Tensor,
    ) -> tuple[Refined, Hypotheses]:
        """Choose and fit. Hypotheses are the surface of 1/8 and its rims.

        Volume at 1/4; px at 1/8 and, 0 where unknown, at 1/4; hidden state at 1/8, context at 1/4.
        """
        u, _ = cell_centres(prior.shape[2], prior.shape[3], 4, prior)
        column = (u - 1.5) * (1 / FINE_PX)

        def position(d: Tensor) -> Tensor:
            return column - d * (1 / FINE_PX)

        plain = F.interpolate(d_eighth, scale_factor=2.0, mode="bilinear")
        hole = (prior <= 0).to(prior.dtype)
        carried = prior + hole * plain
        surfaces = torch.cat((plain, enlarge(rims(d_eighth))), dim=1)
        cost = lookup(pairs, position(surfaces))
        wide = box3(cost)
        apart = squash(torch.cat((surfaces[:, 1:], carried), dim=1) - plain, 2.0)
        measured = torch.cat((cost, wide, apart, beyond(surfaces, scale=4)), dim=1)
        x = F.relu(joint(self.first, context, measured) + enlarge(self.hidden(hidden)))
        # The outline of an object shows only in a wider window than 3x3 cells.
        low = F.relu6(self.lower(F.relu6(self.low(F.relu6(self.down(x))))))
        x = F.relu(x + enlarge(self.back(low)))
        fixed = cost * self.sharpness[0] + wide * self.sharpness[1]
        hypotheses = Hypotheses(surfaces, fixed + 4 * self.choose(x))
        d = hypotheses.mean()

        # Sub-pixel: the centre of the peak that the window's mean makes along the surface. A
        # larger position is a smaller disparity.
        looked_at = position(d)
        taps = lookup_row(pairs, looked_at, REACH)
        smooth = box3(taps)
        tap_px = torch.arange(REACH, -REACH - 1, -1, device=d.device).to(d.dtype) * FINE_PX
        offset = expected(self.subpixel * smooth, tap_px[:, None, None])
        d = d + offset
        step = carried - d
        # Interpolation flattens a peak between two entries: the place between them is an input.
        phase = (looked_at - torch.floor(looked_at)).detach()
        steps = squash(torch.cat((step, offset), dim=1), 0.5)
        fitted = (taps, smooth, steps, apart[:, :2], phase, hole)
        x = F.relu(joint(self.second, x, torch.cat(fitted, dim=1)))
        out = self.out(x)
        # While the previous frame's surface agrees, move towards it: at first half of a small step.
        keep = torch.sigmoid(4 * out[:, 1:2]) * torch.exp(-step.abs()) * (1 - hole)
        d = (d + keep * step + 2 * out[:, :1]).clamp(min=MIN_PX)
        return Refined(d, out[:, 2:], x), hypotheses

    def enlarged(self, found: Refined) -> tuple[Tensor, Tensor]:
        """Full-size disparity and sigma, px [B, H, W]; sigma is that of cells of 4x4 pixels."""
        # Half a pixel at first; within e^-3.5 and e^4 times that.
        sigma = 0.5 * torch.exp((4 * found.doubt).clamp(-3.5, 4.0))
        full = self.upsample(found.features, found.disparity)
        # Columns first, then whole rows: those are quick to repeat.
        rows = sigma[:, 0, :, :, None].expand(-1, -1, -1, 4).flatten(2)
        return full, rows[:, :, None].expand(-1, -1, 4, -1).reshape(full.shape)
