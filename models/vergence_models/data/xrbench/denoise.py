"""Denoising, which allows fewer light paths: it smooths light, never textures or outlines."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vergence_models.data.xrbench.tracer import Planes, TracedLight

_LEVELS = 5  # the last one reaches 16 pixels
_FLOOR = 0.01  # added to the albedo, so that black can be divided by
_EDGE = 0.35  # neighbours whose light differs by this factor (in logarithm) are not mixed
_LIKENESS = 6  # exponent of the cosine between normals: 0.1 for pixels half on either wall
_DEPTH = 0.02  # relative step in depth that separates surfaces, a pixel
_BRIGHTEST = 30.0  # times the median: brighter single paths are fireflies


def denoised(light: TracedLight, keep: NDArray[np.bool_] | None = None) -> Planes:
    """Linear RGB [H, W, 3]; pixels in `keep` [H, W] (mirrors, glass) stay as they came.

    Divides by the albedo, smooths what is left across like normals and depths, multiplies again
    (edge-avoiding a-trous, Dammertz et al. 2010): textures come from the noiseless albedo.
    """
    surface = light.depth_m > 0
    albedo = np.where(surface, light.albedo + np.float32(_FLOOR), np.float32(1))
    value = np.asarray(light.radiance / albedo, np.float32)
    brightness = value.mean(-1, keepdims=True)
    limit = _BRIGHTEST * np.median(brightness) + 1e-6
    value *= np.minimum(1, limit / np.maximum(brightness, 1e-9))
    depth = np.where(surface, light.depth_m, np.float32(1e6))
    length = np.linalg.norm(light.normals, axis=-1, keepdims=True)
    normals = light.normals / np.maximum(length, 1e-6)
    for level in range(_LEVELS):
        value = _smoothed(value, normals, depth, step=2**level, edges=level >= 2)
    result = value * albedo
    still = ~surface[..., 0] if keep is None else ~surface[..., 0] | keep
    result[still] = light.radiance[still]
    return np.asarray(result, np.float32)


def _smoothed(value: Planes, normals: Planes, depth: Planes, *, step: int, edges: bool) -> Planes:
    """One level: the eight neighbours `step` pixels away, weighted by likeness."""
    height, width = value.shape[:2]
    logs = np.log(value.mean(-1, keepdims=True) + 1e-4) if edges else None
    total, weights = 4 * value, np.full((height, width, 1), 4.0, np.float32)
    for dy in (-step, 0, step):
        for dx in (-step, 0, step):
            here = np.s_[max(0, -dy) : height - max(0, dy), max(0, -dx) : width - max(0, dx)]
            there = np.s_[max(0, dy) : height + min(0, dy), max(0, dx) : width + min(0, dx)]
            if (dx, dy) == (0, 0) or total[here].size == 0:
                continue
            alike = np.einsum("hwk,hwk->hw", normals[here], normals[there])[..., None]
            weight = np.clip(alike, 0, 1) ** _LIKENESS * (1.0 if dx and dy else 2.0)
            apart = np.abs(depth[here] - depth[there]) / (depth[here] * _DEPTH * step)
            if logs is not None:
                apart += np.abs(logs[here] - logs[there]) / _EDGE
            weight *= np.exp(-apart)
            total[here] += weight * value[there]
            weights[here] += weight
    return np.asarray(total / weights, np.float32)
