"""Ray intersections with canonical shapes, each in its own frame where it spans [-1, 1].

A ray is ``origin + t * direction``; with a camera ray direction of (x, y, 1) before the change of
frame, t is the depth along the optical axis. Every function broadcasts parameters [P, 1] against
rays [P, S] and returns t [P, S], infinite where the ray misses.
"""

from __future__ import annotations

from enum import IntEnum

import torch
from torch import Tensor

NEAR_M = 0.02
_MISS = float("inf")

Vector = tuple[Tensor, Tensor, Tensor]


class Shape(IntEnum):
    """The shape of a primitive; PAD fills scenes of a batch up to one length and is never hit."""

    PAD = -1
    QUAD = 0  # z = 0, |x|, |y| <= 1, cut by a `Cutout`
    BOX = 1
    ELLIPSOID = 2
    CYLINDER = 3  # axis z; its radius is 1 + taper * z


class Cutout(IntEnum):
    """The outline of a quad."""

    FULL = 0
    DISC = 1
    LEAF = 2
    GRID = 3  # a lattice of bars
    RING = 4


def intersect(
    shape: Shape, origin: Vector, direction: Vector, *, taper: Tensor, cutout: Tensor
) -> Tensor:
    """Depth of the first hit beyond `NEAR_M`. Shapes seen from inside are not hit (but quads)."""
    if shape is Shape.QUAD:
        return _quad(origin, direction, cutout)
    if shape is Shape.BOX:
        return _box(origin, direction)
    if shape is Shape.ELLIPSOID:
        return _sphere(origin, direction)
    return _cylinder(origin, direction, taper)


def _accept(t: Tensor, hit: Tensor) -> Tensor:
    return torch.where(hit & (t > NEAR_M), t, _MISS)


def _quad(origin: Vector, direction: Vector, cutout: Tensor) -> Tensor:
    t = -origin[2] / direction[2]
    x = origin[0] + t * direction[0]
    y = origin[1] + t * direction[1]
    inside = torch.maximum(x.abs(), y.abs()) <= 1
    if bool((cutout > 0).any()):
        inside &= _inside_cutout(x, y, cutout)
    return _accept(t, inside)


def _inside_cutout(x: Tensor, y: Tensor, cutout: Tensor) -> Tensor:
    radius_squared = x * x + y * y
    # Distance to the nearest bar; the outermost bars lie on the border.
    lattice = torch.minimum(((x * 3.5 + 8).frac() - 0.5).abs(), ((y * 3.5 + 8).frac() - 0.5).abs())
    inside = cutout == Cutout.FULL
    inside = inside | ((cutout == Cutout.DISC) & (radius_squared <= 1))
    # A parabola on each side of the midrib, widest a little below the middle.
    width = 0.75 * (1 - y * y) * (1 - 0.4 * y)
    inside = inside | ((cutout == Cutout.LEAF) & (x.abs() <= width))
    inside = inside | ((cutout == Cutout.GRID) & (lattice < 0.1))
    return inside | ((cutout == Cutout.RING) & (radius_squared <= 1) & (radius_squared >= 0.55))


def _box(origin: Vector, direction: Vector) -> Tensor:
    enter, leave = _slab(origin[0], direction[0])
    for axis in (1, 2):
        near, far = _slab(origin[axis], direction[axis])
        enter, leave = torch.maximum(enter, near), torch.minimum(leave, far)
    return _accept(enter, enter <= leave)


def _slab(origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    inverse = 1 / direction
    middle, half = -origin * inverse, inverse.abs()
    return middle - half, middle + half


def _sphere(origin: Vector, direction: Vector) -> Tensor:
    ox, oy, oz = origin
    dx, dy, dz = direction
    # From the point of closest approach: no cancellation for small far spheres in float32.
    inverse = 1 / (dx * dx + dy * dy + dz * dz)
    closest = -(ox * dx + oy * dy + oz * dz) * inverse
    qx, qy, qz = ox + closest * dx, oy + closest * dy, oz + closest * dz
    half_squared = (1 - qx * qx - qy * qy - qz * qz) * inverse
    return _accept(closest - half_squared.clamp(min=0).sqrt(), half_squared > 0)


def _cylinder(origin: Vector, direction: Vector, taper: Tensor) -> Tensor:
    ox, oy, oz = origin
    dx, dy, dz = direction
    # As for the sphere, the quadratic starts where the ray is closest to the axis.
    start = -(ox * dx + oy * dy) / (dx * dx + dy * dy + 1e-12)
    qx, qy, qz = ox + start * dx, oy + start * dy, oz + start * dz
    radius = 1 + taper * qz
    slope = taper * dz
    a = dx * dx + dy * dy - slope * slope
    b = radius * slope  # minus half the linear coefficient
    discriminant = b * b - a * (qx * qx + qy * qy - radius * radius)
    t_side = start + (b - a.sign() * discriminant.clamp(min=0).sqrt()) / (a + 1e-12)
    t_side = _accept(t_side, (discriminant > 0) & ((oz + t_side * dz).abs() <= 1))
    side = -dz.sign()  # the cap that faces the ray
    t_cap = (side - oz) / dz
    cx, cy = ox + t_cap * dx, oy + t_cap * dy
    cap_radius = 1 + taper * side
    return torch.minimum(t_side, _accept(t_cap, cx * cx + cy * cy <= cap_radius * cap_radius))
