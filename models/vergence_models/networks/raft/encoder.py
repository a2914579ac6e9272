"""Features of both images for matching, and context of the left image at 1/8 and 1/16.

One trunk for all three, as in RAFT-Stereo's realtime network (Lipson, Teed, Deng; 3DV 2021).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vergence_models.config import RaftNetworkConfig
from vergence_models.networks.layers import standardized


def normed(inputs: int, outputs: int, *, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    """A convolution and its batch norm, which export folds into one."""
    layer = nn.Conv2d(inputs, outputs, kernel, stride, padding=kernel // 2)
    nn.init.kaiming_normal_(layer.weight, mode="fan_out", nonlinearity="relu")
    return nn.Sequential(layer, nn.BatchNorm2d(outputs))


class ResidualBlock(nn.Module):
    """Two convolutions beside a shortcut, [B, I, H, W] to [B, O, H/s, W/s]."""

    def __init__(self, inputs: int, outputs: int, *, stride: int = 1) -> None:
        super().__init__()
        self.first = normed(inputs, outputs, stride=stride)
        self.second = normed(outputs, outputs)
        self.shortcut = (
            nn.Identity()
            if stride == 1 and inputs == outputs
            else normed(inputs, outputs, kernel=1, stride=stride)
        )

    def forward(self, x: Tensor) -> Tensor:
        y = F.relu(self.second(F.relu(self.first(x))))
        return F.relu(self.shortcut(x) + y)


class MatchingHead(nn.Module):
    """Features to match: a residual block whose norm is each image's own, then a projection.

    Two eyes differ in exposure and glare; a batch's statistics would carry that into the match.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(inputs, inputs, 3, padding=1)
        self.second = nn.Conv2d(inputs, inputs, 3, padding=1)
        self.leave = nn.Conv2d(inputs, outputs, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        y = F.relu(standardized(self.first(x)))
        y = F.relu(standardized(self.second(y)))
        return self.leave(F.relu(x + y))  # type: ignore[no-any-return]  # torch types it so


class ContextHead(nn.Module):
    """At one scale: where the hidden state starts, and what the gates of every iteration add."""

    def __init__(self, inputs: int, hidden: int) -> None:
        super().__init__()
        self.start = nn.Sequential(
            ResidualBlock(inputs, inputs), nn.Conv2d(inputs, hidden, 3, padding=1)
        )
        self.context = nn.Sequential(
            ResidualBlock(inputs, inputs), nn.Conv2d(inputs, hidden, 3, padding=1)
        )
        self.gates = nn.Conv2d(hidden, 3 * hidden, 3, padding=1)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Hidden state and context [B, C, H, W], and terms of the gates [B, 3 C, H, W]."""
        context = F.relu(self.context(x))
        return torch.tanh(self.start(x)), context, self.gates(context)


class Encoding(NamedTuple):
    """The features of a pair, before any iteration."""

    left: Tensor  # [B, C, H/8, W/8], to match
    right: Tensor  # the same shape
    context: Tensor  # [B, C, H/8, W/8] of the left image
    hidden: tuple[Tensor, Tensor]  # at 1/8 and 1/16
    gates: tuple[Tensor, Tensor]  # at 1/8 and 1/16


class Encoder(nn.Module):
    """Both images in one batch through the trunk; context is taken from the left half."""

    def __init__(self, config: RaftNetworkConfig) -> None:
        super().__init__()
        half, quarter, eighth = config.encoder_half, config.encoder_quarter, config.encoder_eighth
        self.trunk = nn.Sequential(
            normed(3, half, kernel=7, stride=2),
            nn.ReLU(),
            ResidualBlock(half, half),
            ResidualBlock(half, half),
            ResidualBlock(half, quarter, stride=2),
            ResidualBlock(quarter, quarter),
            ResidualBlock(quarter, eighth, stride=2),
            ResidualBlock(eighth, eighth),
        )
        self.to_sixteenth = nn.Sequential(
            ResidualBlock(eighth, eighth, stride=2), ResidualBlock(eighth, eighth)
        )
        self.matching = MatchingHead(eighth, config.features)
        self.context8 = ContextHead(eighth, config.hidden)
        self.context16 = ContextHead(eighth, config.hidden)

    def forward(self, left: Tensor, right: Tensor) -> Encoding:
        """``left`` and ``right`` uint8 [B, H, W, 3]."""
        both = torch.cat((left, right)).permute(0, 3, 1, 2)
        x = self.trunk(both.float() * (2 / 255) - 1)
        batch = left.shape[0]
        features = self.matching(x)
        eighth = x[:batch]
        hidden8, context, gates8 = self.context8(eighth)
        hidden16, _, gates16 = self.context16(self.to_sixteenth(eighth))
        return Encoding(
            features[:batch], features[batch:], context, (hidden8, hidden16), (gates8, gates16)
        )
