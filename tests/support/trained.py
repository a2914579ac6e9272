"""Networks with weights like those of trained ones, without training."""

from __future__ import annotations

from typing import TypeVar

import torch
from torch import nn

Network = TypeVar("Network", bound=nn.Module)


def as_trained(network: Network) -> Network:
    """Give it heads that are not zero and norms that are not the identity; for inference.

    A new network's answer does not depend on much of what leads to it, and then comparing answers
    proves little.
    """
    with torch.no_grad():
        for parameter in network.parameters():
            if parameter.dim() == 4 and not parameter.any():
                parameter.normal_(0, 0.02)
        for module in network.modules():
            if isinstance(module, nn.BatchNorm2d):
                assert module.running_mean is not None
                assert module.running_var is not None
                module.running_mean.uniform_(-0.3, 0.3)
                module.running_var.uniform_(0.5, 1.5)
    return network.eval()
