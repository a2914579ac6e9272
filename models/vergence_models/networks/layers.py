"""Layers of the networks: census descriptors, volumes, the recurrent cell, the upsampler.

Each is written so that onnxruntime runs it fast on a CPU: matrix products and gathers along the
last axis, exp and sum instead of Softmax, slices instead of unfold, no norm layers. Each starts as
a method of classical stereo, with the learned part at zero, so an untrained network already
matches.
"""

from __future__ import annotations

import functools
import itertools
import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

# Comparisons of a pixel with half of its 5x5 neighbourhood: the other half would repeat them.
CENSUS_OFFSETS = (
    (1, 0), (2, 0), (0, 1), (0, 2), (1, 1), (-1, 1),
    (2, 1), (-2, 1), (1, 2), (-1, 2), (2, 2), (-2, 2),
)  # fmt: skip


class CensusDescriptor(nn.Module):
    """Soft census bits of every 2x2 block of pixels: clip(difference / contrast, -1, 1).

    One convolution with a clip. It starts as the census transform, whose sign is softened so that
    noise on a blank wall is no pattern, and learns from there, its filters blind to brightness.
    """

    def __init__(self, bits: int, *, contrast: float) -> None:
        super().__init__()
        weight = torch.zeros(bits, 1, 6, 6)
        for bit in range(bits):
            dx, dy = CENSUS_OFFSETS[bit // 4 % len(CENSUS_OFFSETS)]
            x, y = 2 + bit % 2, 2 + bit // 2 % 2
            weight[bit, 0, y, x] = -1
            weight[bit, 0, y + dy, x + dx] = 1
        self.weight = nn.Parameter(weight)
        self.contrast = contrast

    def forward(self, gray: Tensor, column_stride: int) -> Tensor:
        """``gray`` [B, 1, H, W] to [B, bits, H/2, W/column_stride]: a block every few pixels."""
        weight = (self.weight - self.weight.mean(dim=(2, 3), keepdim=True)) * (1 / self.contrast)
        padded = F.pad(gray, (2, 3, 2, 3), mode="replicate")
        return F.conv2d(padded, weight, stride=(2, column_stride)).clamp(-1, 1)


def all_pairs(left: Tensor, right: Tensor) -> Tensor:
    """Mean product of descriptors along each row: [B, C, H, W] x [B, C, H, W'] -> [B, H, W, W']."""
    rows, other = (each.permute(0, 2, 3, 1) for each in (left, right))
    return torch.matmul(rows * (1 / left.shape[1]), other.transpose(2, 3))


def banded(pairs: Tensor, disparities: int) -> Tensor:
    """Re-index all pairs (x, x') [B, H, W, rW] by disparity r x - x': [B, H, W, D], 0 outside.

    Row x of the result starts r entries later than row x - 1 in memory; so with rows that are r
    entries longer it becomes a plain slice. Columns run from the largest disparity to 0.
    """
    batch, height, width, columns = pairs.shape
    ratio = columns // width
    first = disparities - 1
    flat = F.pad(pairs.reshape(batch, height, width * columns), (first, columns - first))
    skewed = flat.view(batch, height, width, columns + ratio)[..., :disparities]
    x = torch.arange(width, device=pairs.device)[:, None]
    d = torch.arange(first, -1, -1, device=pairs.device)[None, :]
    return skewed * (d <= x * ratio).to(pairs.dtype)


def best_rival(scores: Tensor, ratio: int) -> Tensor:
    """For each match (x, d), the best score that its right pixel has with any left pixel.

    A match that scores below it is claimed by another surface: the sign of an occlusion.
    ``scores`` [B, D, H, W], largest disparity first, as many as a multiple of ``ratio``: so much
    further along the right row is the next cell. The result has the same shape.

    ``ratio`` disparities are a group; the next group's matches with the same right pixels are one
    cell further left. So in rows that have some space left, and groups that are one entry shorter
    than they are, these matches stand one above the other.
    """
    batch, disparities, height, width = scores.shape
    groups, wide = disparities // ratio, width + disparities // ratio
    size = ratio * height * wide
    flat = F.pad(scores, (0, groups), value=-1e4).reshape(batch, groups * size)
    meeting = flat[:, groups - 1 : groups * size - 1].view(batch, groups, size - 1)
    best = F.pad(meeting.amax(dim=1), (0, 1)).view(batch, ratio, height, wide)
    # And the same way back. What lies outside of the image, to the left, has the first one's rival.
    first = best[:, -1:, :, :1].expand(-1, ratio, -1, groups)
    best = torch.cat((first, best[..., 1 : width + 1]), dim=3).view(batch, 1, size)
    again = best[..., : size - 1].expand(-1, groups + 1, -1).reshape(batch, -1)
    rivals = again[:, : groups * size].view(batch, disparities, height, wide)
    return rivals[..., :width]


def box3(x: Tensor) -> Tensor:
    """Mean over 3x3 cells, borders counting the cells there are: [B, C, H, W]."""
    return F.avg_pool2d(x, 3, stride=1, padding=1, count_include_pad=False)


def enlarge(x: Tensor) -> Tensor:
    """Twice the size, each cell repeated."""
    return F.interpolate(x, scale_factor=2.0, mode="nearest")


def standardized(x: Tensor) -> Tensor:
    """Instance norm: every channel of every image to mean 0 and variance 1, [B, C, H, W]."""
    x = x.float()
    centred = x - x.mean(dim=(2, 3), keepdim=True)
    return centred * torch.rsqrt(centred.square().mean(dim=(2, 3), keepdim=True) + 1e-5)


def expected(scores: Tensor, values: Tensor) -> Tensor:
    """Mean of ``values`` by the softmax of ``scores``: [B, C, H, W] to [B, 1, H, W].

    By exp and sum: onnxruntime's softmax is twenty times slower off the last axis.
    """
    weights = torch.exp(scores - scores.amax(dim=1, keepdim=True))
    return (weights * values).sum(dim=1, keepdim=True) / weights.sum(dim=1, keepdim=True)


def conv(inputs: int, outputs: int, *, kernel: int = 3, stride: int = 1) -> nn.Conv2d:
    """A convolution with He initialisation and no bias offset; padded if its kernel is odd."""
    layer = nn.Conv2d(inputs, outputs, kernel, stride, padding=kernel // 2 if kernel % 2 else 0)
    nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
    nn.init.zeros_(layer.bias)  # type: ignore[arg-type]  # bias=True above
    return layer


def joint(layer: nn.Conv2d, *parts: Tensor) -> Tensor:
    """``layer(torch.cat(parts, dim=1))`` without the copy: the sum of a convolution of each part.

    Quantised, each part has a scale of its own, and one that comes from a convolution stays bytes.
    """
    weights = torch.split(layer.weight, [part.shape[1] for part in parts], dim=1)
    biases = (layer.bias, *(None for _ in parts[1:]))
    return added(
        [
            F.conv2d(part, weight, bias, layer.stride, layer.padding)
            for part, weight, bias in zip(parts, weights, biases, strict=True)
        ]
    )


def silent(layer: nn.Conv2d) -> nn.Conv2d:
    """The same layer with zero weights: its contribution starts at zero."""
    nn.init.zeros_(layer.weight)
    return layer


class GatedCell(nn.Module):
    """A convolutional GRU cell: hidden [B, C, H, W] and inputs [B, I, H, W] to the next hidden."""

    def __init__(self, hidden: int, inputs: int, *, kernel: int) -> None:
        super().__init__()
        self.gates = conv(hidden + inputs, 2 * hidden, kernel=kernel)
        self.candidate = conv(hidden + inputs, hidden, kernel=kernel)
        nn.init.xavier_normal_(self.gates.weight)
        nn.init.xavier_normal_(self.candidate.weight)
        self.hidden = hidden

    def forward(self, hidden: Tensor, inputs: Tensor) -> Tensor:
        gates = torch.sigmoid(self.gates(torch.cat((hidden, inputs), dim=1)))
        update, reset = gates[:, : self.hidden], gates[:, self.hidden :]
        candidate = torch.tanh(self.candidate(torch.cat((reset * hidden, inputs), dim=1)))
        return hidden + update * (candidate - hidden)


class ConvexUpsampler(nn.Module):
    """Each pixel of a 4x4 block is a convex combination of the four cells round its quadrant.

    It starts as bilinear upsampling; a pixel beside an edge learns to take one side. The four
    nearest cells do what nine would, at less than half the price.
    """

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.mask = silent(conv(inputs, 64, kernel=1))
        with torch.no_grad():
            bias = torch.empty(2, 2, 4, 2, 2)  # quadrant (y, x), cell, pixel in quadrant (y, x)
            for qy, qx, ry, rx in itertools.product(range(2), repeat=4):
                # Distance from the cell's centre towards the neighbour on this quadrant's side.
                y = abs((2 * qy + ry + 0.5) / 4 - 0.5)
                x = abs((2 * qx + rx + 0.5) / 4 - 0.5)
                weights = ((1 - y) * (1 - x), (1 - y) * x, y * (1 - x), y * x)
                bias[qy, qx, :, ry, rx] = torch.log(torch.tensor(weights))
            self.mask.bias.copy_(bias.flatten())  # type: ignore[union-attr]  # conv has a bias

    def forward(self, features: Tensor, disparity: Tensor) -> Tensor:
        """``features`` [B, C, h, w], ``disparity`` [B, 1, h, w] to [B, 4 h, 4 w]."""
        batch, _, height, width = disparity.shape
        # The parameters' order is (quadrant, cell, pixel), each (y, x). With the cells first and
        # the pixels in the order they are wanted in, a cell's shares are one block of channels.
        assert self.mask.bias is not None
        both = torch.cat((self.mask.weight.flatten(1), self.mask.bias[:, None]), dim=1)
        both = both.view(2, 2, 4, 2, 2, -1).permute(2, 0, 3, 1, 4, 5).reshape(4, 16, -1)
        padded = F.pad(disparity, (1, 1, 1, 1), mode="replicate")
        rows = torch.cat((padded[:, :, :-2], padded[:, :, 2:]), dim=1)  # above, below
        beside = torch.cat((padded[:, :, 1:-1, :-2], padded[:, :, 1:-1, 2:]), dim=1) - disparity
        other = rows[..., 1:-1] - disparity
        corner = torch.stack((rows[..., :-2], rows[..., 2:]), dim=2) - disparity[:, None]
        # Seen from [B, quadrant y, pixel y, quadrant x, pixel x, h, w]:
        near = (
            beside[:, None, None, :, None],
            other[:, :, None, None, None],
            corner[:, :, None, :, None],
        )
        shares, steps = [], []
        # A softmax needs no more than differences of scores; with those to the own cell's, that
        # cell needs neither an exponential nor a product.
        for weights, step in zip(both[1:] - both[:1], near, strict=True):
            scores = F.conv2d(features, weights[:, :-1, None, None], weights[:, -1])
            # Bounded scores need no maximum to be subtracted before the exponential.
            share = torch.exp(scores.clamp(-24, 24)).view(batch, 2, 2, 2, 2, height, width)
            shares.append(share)
            steps.append(share * step)
        blocks = (added(steps) / (added(shares) + 1)).view(batch, 16, height, width) + disparity
        return F.pixel_shuffle(blocks, 4).squeeze(1)


def added(terms: list[Tensor]) -> Tensor:
    """Sum of tensors that broadcast; ``sum`` would start from an integer zero."""
    return functools.reduce(torch.add, terms)


def squash(px: Tensor, scale: float) -> Tensor:
    """Signed logarithm of a difference in pixels: fine near zero, bounded far from it."""
    return torch.sign(px) * torch.log1p(px.abs() / scale) / math.log(10.0)
