"""One iteration: look up the correlation, update both hidden states, correct the disparity.

Layers and shapes are RAFT-Stereo's; motion has one component here, the disparity.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vergence_models.config import RaftNetworkConfig
from vergence_models.networks.cost_volume import lookup_row, whole_rows
from vergence_models.networks.layers import all_pairs, silent

CELL_PX = 8  # size of a cell of the matched features
LEVELS = 4
REACH = 4  # entries looked up on either side, at every level


def correlation(left: Tensor, right: Tensor) -> Tensor:
    """All pairs of features along each row, [B, C, H, W] each: [B, H, W, W]."""
    return all_pairs(left, right).float() * math.sqrt(left.shape[1])


def pyramid(pairs: Tensor) -> list[Tensor]:
    """The correlation averaged over 1, 2, 4 and 8 right cells: [B, H, W, W / 2^k] each."""
    levels = [pairs]
    for _ in range(LEVELS - 1):
        levels.append(F.avg_pool2d(levels[-1], (1, 2)))
    return levels


def looked_up(levels: list[Tensor], d: Tensor) -> Tensor:
    """Correlations round disparity ``d`` [B, 1, H, W] px: [B, LEVELS (2 REACH + 1), H, W]."""
    column = right_column(d)
    found = [
        lookup_row(whole_rows(pairs), (column + 0.5) / 2**level - 0.5, REACH)
        for level, pairs in enumerate(levels)
    ]
    return torch.cat(found, dim=1)


def right_column(d: Tensor) -> Tensor:
    """The right image's cell that matches each left cell at disparity ``d`` [..., W] px."""
    return torch.arange(d.shape[-1], device=d.device).to(d.dtype) - d * (1 / CELL_PX)


class MotionEncoder(nn.Module):
    """Encodes the looked-up correlation and the disparity as inputs of the cell."""

    def __init__(self, config: RaftNetworkConfig) -> None:
        super().__init__()
        width, outputs = config.motion, config.hidden
        self.correlation = nn.Sequential(
            nn.Conv2d(LEVELS * (2 * REACH + 1), width, 1),
            nn.ReLU(),
            nn.Conv2d(width, width, 3, padding=1),
            nn.ReLU(),
        )
        self.disparity = nn.Sequential(
            nn.Conv2d(1, width, 7, padding=3),
            nn.ReLU(),
            nn.Conv2d(width, width, 3, padding=1),
            nn.ReLU(),
        )
        self.leave = nn.Conv2d(2 * width, outputs - 1, 3, padding=1)

    def forward(self, d: Tensor, correlation: Tensor) -> Tensor:
        cells = d * (1 / CELL_PX)
        both = torch.cat((self.correlation(correlation), self.disparity(cells)), dim=1)
        return torch.cat((F.relu(self.leave(both)), cells), dim=1)


class ContextGru(nn.Module):
    """A convolutional GRU; a context that is the same in every iteration biases its gates."""

    def __init__(self, hidden: int, inputs: int) -> None:
        super().__init__()
        self.gates = nn.Conv2d(hidden + inputs, 2 * hidden, 3, padding=1)
        self.candidate = nn.Conv2d(hidden + inputs, hidden, 3, padding=1)
        self.hidden = hidden

    def forward(self, hidden: Tensor, context: Tensor, inputs: Tensor) -> Tensor:
        """``hidden`` [B, C, H, W], ``context`` [B, 3 C, H, W], ``inputs`` [B, I, H, W]."""
        split = 2 * self.hidden
        gates = self.gates(torch.cat((hidden, inputs), dim=1)) + context[:, :split]
        update, reset = torch.sigmoid(gates).chunk(2, dim=1)
        candidate = self.candidate(torch.cat((reset * hidden, inputs), dim=1))
        return hidden + update * (torch.tanh(candidate + context[:, split:]) - hidden)


class Update(nn.Module):
    """One iteration of both levels; the coarse level is cheap and runs twice (slow-fast)."""

    def __init__(self, config: RaftNetworkConfig) -> None:
        super().__init__()
        hidden = config.hidden
        self.motion = MotionEncoder(config)
        self.cell8 = ContextGru(hidden, 2 * hidden)
        self.cell16 = ContextGru(hidden, hidden)
        self.head = nn.Sequential(
            nn.Conv2d(hidden, config.head, 3, padding=1),
            nn.ReLU(),
            silent(nn.Conv2d(config.head, 1, 3, padding=1)),
        )

    def forward(
        self,
        hidden: tuple[Tensor, Tensor],
        gates: tuple[Tensor, Tensor],
        d: Tensor,
        levels: list[Tensor],
    ) -> tuple[tuple[Tensor, Tensor], Tensor]:
        """Hidden states at 1/8 and 1/16 and disparity [B, 1, H/8, W/8] px to the next ones."""
        hidden8, hidden16 = hidden
        pooled = F.avg_pool2d(hidden8, 2)
        for _ in range(2):
            hidden16 = self.cell16(hidden16, gates[1], pooled)
        # No gradient flows to the start of an iteration: it learns from its own result alone.
        d = d.detach()
        motion = self.motion(d, looked_up(levels, d))
        wide = F.interpolate(hidden16, scale_factor=2.0, mode="bilinear")
        hidden8 = self.cell8(hidden8, gates[0], torch.cat((motion, wide), dim=1))
        return (hidden8, hidden16), d + self.head(hidden8) * CELL_PX


class RaftUpsampler(nn.Module):
    """Disparity at full size, each pixel a convex combination of the nine cells round it; sigma."""

    def __init__(self, config: RaftNetworkConfig) -> None:
        super().__init__()
        self.enter = nn.Conv2d(config.hidden, config.head, 3, padding=1)
        self.mask = nn.Conv2d(config.head, 9 * CELL_PX**2, 1)
        self.log_sigma = silent(nn.Conv2d(config.head, 1, 1))

    def forward(self, hidden: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        """``hidden`` and ``d`` px at 1/8 to disparity and sigma, [B, H, W] px each."""
        _, _, height, width = d.shape
        x = F.relu(self.enter(hidden))
        # Bounded scores need no maximum to be subtracted before the exponential. The quarter is
        # RAFT's: it balances the gradients.
        weights = torch.exp((0.25 * self.mask(x).float()).clamp(-12, 12))
        padded = F.pad(d, (1, 1, 1, 1), mode="replicate")
        total, mass = torch.zeros_like(d), torch.zeros_like(d)
        for cell in range(9):
            share = weights[:, cell * CELL_PX**2 : (cell + 1) * CELL_PX**2]
            row, column = divmod(cell, 3)
            near = padded[:, :, row : row + height, column : column + width]
            total, mass = total + share * near, mass + share
        full = F.pixel_shuffle(total / mass, CELL_PX)
        # A pixel at first; within e^-4 and e^4 of it.
        sigma = torch.exp(self.log_sigma(x).float().clamp(-4, 4))
        large = F.interpolate(sigma, scale_factor=float(CELL_PX), mode="bilinear")
        return full[:, 0], large[:, 0]
