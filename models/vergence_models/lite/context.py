"""What the left image alone says."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

from vergence_models.config import LiteNetworkConfig
from vergence_models.layers import conv, enlarge
from vergence_models.lite.coarse import CELL_INPUTS


class Context(nn.Module):
    """What the left image alone says, at 1/4, 1/8 and 1/16, with a view down to 1/32.

    Activations are bounded where nothing normalises them. Unbounded, they grew a hundred thousand
    times larger in training than the evidence they stand beside, and closed every gate for good.
    """

    def __init__(self, config: LiteNetworkConfig) -> None:
        super().__init__()
        quarter, eighth, low = config.context_quarter, config.context_eighth, config.context_low
        # Interleaved RGB rows are one channel three times as wide: a patch of 4x4 pixels is a
        # kernel of 4x12, and no transpose is needed.
        self.patch = nn.Conv2d(1, quarter, (4, 12), (4, 12))
        self.quarter = conv(quarter, quarter)
        self.to_eighth = conv(quarter, eighth, stride=2)
        self.eighth = conv(eighth, eighth)
        self.to_sixteenth = conv(eighth, low, stride=2)
        self.to_thirtysecond = conv(low, low, stride=2)
        self.thirtysecond = conv(low, low)
        self.sixteenth = conv(low, low)
        self.back = conv(low, eighth, kernel=1)
        self.leave = conv(eighth, 64 - config.hidden - CELL_INPUTS, kernel=1)

    def forward(self, interleaved: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """``interleaved`` [B, 1, H, 3 W] in 0..255."""
        # Colours are centred in the weights: cheaper than in the image.
        weight = self.patch.weight * (1 / 128)
        assert self.patch.bias is not None
        bias = self.patch.bias - weight.sum(dim=(1, 2, 3)) * 128
        patch = F.conv2d(interleaved, weight, bias, stride=(4, 12))
        quarter = F.relu(self.quarter(F.relu(patch)))
        eighth = F.relu6(self.eighth(F.relu6(self.to_eighth(quarter))))
        sixteenth = F.relu6(self.to_sixteenth(eighth))
        low = F.relu6(self.thirtysecond(F.relu6(self.to_thirtysecond(sixteenth))))
        sixteenth = F.relu6(self.sixteenth(sixteenth + enlarge(low)))
        eighth = F.relu6(eighth + enlarge(self.back(sixteenth)))
        return quarter, F.relu6(self.leave(eighth)), sixteenth
