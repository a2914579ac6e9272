"""Depth in the number formats of graphics APIs, browsers and ROS.

All functions take depth in metres, float32 [H, W], NaN where there is no value, row 0 on top.
"""

import math

import numpy as np
from numpy.typing import NDArray

from vergence_proto.types import Plane

_D16_MAX = 65535


def d16(
    depth_m: Plane,
    near_m: float = 0.1,
    far_m: float = math.inf,
    *,
    reversed_z: bool = False,
    bottom_up: bool = False,
) -> NDArray[np.uint16]:
    """Return a depth buffer of 16 bits, as a projection with these clip planes would write it.

    The stored number is ``65535 * z``, with ``z = far / (far - near) * (1 - near / Z)`` from 0 at
    the near plane to 1 at the far one (Vulkan, Direct3D, and OpenXR's
    ``XrCompositionLayerDepthInfoKHR`` with minDepth 0 and maxDepth 1). Depth in front of the near
    plane is stored as near, beyond the far plane and without a value as far.

    Parameters
    ----------
    depth_m
        Float32 [H, W], metres along the optical axis; NaN: no value.
    near_m, far_m
        The clip planes in metres; ``far_m`` may be infinite.
    reversed_z
        Store ``1 - z``, which keeps precision far away.
    bottom_up
        Store the lowest row first, as OpenGL's textures have it.

    Raises
    ------
    ValueError
        The planes are not ``0 < near_m < far_m``.
    """
    if not 0 < near_m < far_m or math.isinf(near_m):
        raise ValueError(f"expected 0 < near_m < far_m in metres, got {near_m} and {far_m}")
    scale = 1.0 if math.isinf(far_m) else far_m / (far_m - near_m)
    known = depth_m > 0  # false for NaN
    z = np.where(known, scale * (1 - near_m / np.where(known, depth_m, 1)), 1)
    z = np.clip(z, 0, 1)
    stored = np.rint((1 - z if reversed_z else z) * _D16_MAX).astype(np.uint16)
    return np.ascontiguousarray(stored[::-1]) if bottom_up else stored


def depth_from_d16(
    stored: NDArray[np.uint16],
    near_m: float = 0.1,
    far_m: float = math.inf,
    *,
    reversed_z: bool = False,
    bottom_up: bool = False,
) -> Plane:
    """Return the depth in metres of a buffer that :func:`d16` wrote; NaN at the far plane."""
    values = stored[::-1] if bottom_up else stored
    z = values.astype(np.float64) / _D16_MAX
    if reversed_z:
        z = 1 - z
    scale = 1.0 if math.isinf(far_m) else far_m / (far_m - near_m)
    known = z < 1
    return np.where(known, near_m / (1 - np.where(known, z, 0) / scale), np.nan).astype(np.float32)


def webxr(depth_m: Plane, meters_per_unit: float = 0.001) -> NDArray[np.uint16]:
    """Return depth as the WebXR Depth Sensing Module's ``luminance-alpha`` data has it.

    The stored number times ``meters_per_unit`` (``XRDepthInformation.rawValueToMeters``) is the
    depth; 0 means no value. Depth beyond the format's range has none.

    Raises
    ------
    ValueError
        ``meters_per_unit`` is not a positive number.
    """
    if not 0 < meters_per_unit < math.inf:
        raise ValueError(f"expected a positive number of metres a unit, got {meters_per_unit}")
    units = np.rint(depth_m.astype(np.float64) / meters_per_unit)
    known = (units > 0) & (units <= np.iinfo(np.uint16).max)
    return np.where(known, units, 0).astype(np.uint16)
