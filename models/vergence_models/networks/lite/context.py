"""Context features of the left image."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

from vergence_models.config import LiteNetworkConfig
from vergence_models.networks.layers import conv, enlarge
from vergence_models.networks.lite.coarse import CELL_INPUTS

PATCH_BYTES = 4 * 4 * 3


class Context(nn.Module):
    """Context features of the left image at 1/4, 1/8 and 1/16; their receptive field reaches 1/32.

    Activations are bounded where nothing normalises them. Without bounds they grew in training to
    a hundred thousand times the matching scores beside them, and closed every gate for good.
    """

    def __init__(self, config: LiteNetworkConfig) -> None:
        super().__init__()
        quarter, eighth, low = config.context_quarter, config.context_eighth, config.context_low
        self.patch = conv(PATCH_BYTES, quarter, kernel=1)
        self.quarter = conv(quarter, quarter)
        self.to_eighth = conv(quarter, eighth, stride=2)
        self.eighth = conv(eighth, eighth, kernel=1)
        self.to_sixteenth = conv(eighth, low, stride=2)
        self.to_thirtysecond = conv(low, low, stride=2)
        self.thirtysecond = conv(low, low, kernel=1)
        self.sixteenth = conv(low, low, kernel=1)
        self.back = conv(low, eighth, kernel=1)
        self.leave = conv(eighth, 64 - config.hidden - CELL_INPUTS, kernel=1)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """``image`` uint8 [B, H, W, 3]."""
        batch, height, width, _ = image.shape
        rows = image.reshape(batch, height // 4, 4, width // 4, 12).transpose(2, 3)
        patches = rows.reshape(batch, height // 4, width // 4, PATCH_BYTES).permute(0, 3, 1, 2)
        # Colours are scaled and centred in the weights, so that bytes go in as they are.
        weight = self.patch.weight * (1 / 128)
        assert self.patch.bias is not None
        patch = F.conv2d(patches.float(), weight, self.patch.bias - weight.sum(dim=(1, 2, 3)) * 128)
        quarter = F.relu(self.quarter(F.relu(patch)))
        eighth = F.relu6(self.eighth(F.relu6(self.to_eighth(quarter))))
        sixteenth = F.relu6(self.to_sixteenth(eighth))
        low = F.relu6(self.thirtysecond(F.relu6(self.to_thirtysecond(sixteenth))))
        sixteenth = F.relu6(self.sixteenth(sixteenth + enlarge(low)))
        eighth = F.relu6(eighth + enlarge(self.back(sixteenth)))
        return quarter, F.relu6(self.leave(eighth)), sixteenth
