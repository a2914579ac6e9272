"""Int8 weights of a convolution, rounded so that their errors cancel on its typical inputs.

The nearest whole number is best for one weight, but not for a sum of products. Here each weight
compensates the errors of the weights rounded before it, as far as their inputs vary together
(GPTQ, Frantar et al. 2023). The bias compensates the error at the mean input. A third of the
squared error remains, so seven bits, which pair sums allow for most weights, are as good as eight.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from onnx import ModelProto, NodeProto

from vergence_models.onnx_export.pair_sums import range_of_rounding

Array = NDArray[np.generic]
Reals = NDArray[np.float64]

PATCHES = 8000  # drawn from each frame for each convolution; fewer make the sums noisy
# A share of the mean variance: without it, inputs that hardly vary would take errors without limit.
DAMPING = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class PatchStatistics:
    """Statistics of a convolution's input patches: K values, in the order of its weights."""

    mean: Reals  # [K]
    covariance: Reals  # [K, K]


def inputs_of(
    seen: Iterable[Mapping[str, Array]], convolutions: Sequence[NodeProto], model: ModelProto
) -> dict[str, PatchStatistics]:
    """Statistics of the convolutions' input patches, by output tensor.

    The name of that tensor seeds the choice of patches, so it is the same in every graph.
    """
    sizes = {tensor.name: tuple(tensor.dims[2:]) for tensor in model.graph.initializer}
    draws = {
        node.output[0]: np.random.default_rng(zlib.crc32(node.output[0].encode()))
        for node in convolutions
    }
    sums: dict[str, Reals] = {}
    squares: dict[str, Reals] = {}
    frames = 0
    for found in seen:
        frames += 1
        for node in convolutions:
            result = node.output[0]
            drawn = _patches(found[node.input[0]], node, sizes[node.input[1]], draws[result])
            sums[result] = sums.get(result, 0) + drawn.mean(axis=0)
            squares[result] = squares.get(result, 0) + drawn.T @ drawn / len(drawn)
    means = {result: total / frames for result, total in sums.items()}
    return {
        result: PatchStatistics(mean, squares[result] / frames - np.outer(mean, mean))
        for result, mean in means.items()
    }


def _patches(
    image: Array, node: NodeProto, size: tuple[int, ...], draw: np.random.Generator
) -> Reals:
    """Patches of [B, C, H, W] at random places: [PATCHES, C * height * width]."""
    attributes = {entry.name: list(entry.ints) for entry in node.attribute}
    top, left, bottom, right = attributes.get("pads", [0, 0, 0, 0])
    down, across = attributes.get("strides", [1, 1])
    padded = np.pad(image, ((0, 0), (0, 0), (top, bottom), (left, right)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, size, axis=(2, 3))
    windows = windows[:, :, ::down, ::across]
    batch, _, height, width = windows.shape[:4]
    row, y, x = (draw.integers(0, count, PATCHES) for count in (batch, height, width))
    return windows[row, :, y, x].reshape(PATCHES, -1).astype(np.float64)


def rounded(weight: Reals, step: Reals, covariance: Reals | None) -> Reals:
    """Weights [O, K] in whole steps [O]; they obey the pair rule if the nearest numbers do.

    Without a ``covariance`` of the inputs they are the nearest whole numbers.
    """
    wide = step[:, None]
    nearest = np.rint(weight / wide)
    if covariance is None:
        return nearest
    low, high = range_of_rounding(nearest)
    count = len(covariance)
    damped = covariance + np.eye(count) * (DAMPING * np.trace(covariance) / count + 1e-12)
    order = np.argsort(-np.diag(damped), kind="stable")  # what varies most has most to say
    shares = np.linalg.cholesky(np.linalg.inv(damped[np.ix_(order, order)])).T
    rest = weight[:, order].copy()
    found = np.empty_like(weight)
    for at, place in enumerate(order):
        whole = np.clip(np.rint(rest[:, at] / step), low[:, place], high[:, place])
        error = (rest[:, at] - whole * step) / shares[at, at]
        rest[:, at + 1 :] -= np.outer(error, shares[at, at + 1 :])
        found[:, place] = whole
    return found
