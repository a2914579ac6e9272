"""Triangle meshes of simple solids, as numpy arrays, with texture coordinates in metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Matrix = NDArray[np.float64]

_AROUND = 24  # segments of round things


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Vertices are not shared across sharp edges, so that each has one normal."""

    points: Matrix  # [V, 3]
    normals: Matrix  # [V, 3], unit, outwards
    uv: Matrix  # [V, 2], metres along the surface
    faces: NDArray[np.int64]  # [F, 3]

    def moved(self, world_from_mesh: Matrix) -> Mesh:
        """The same mesh after a rigid transform [4, 4]."""
        turn = world_from_mesh[:3, :3]
        points = self.points @ turn.T + world_from_mesh[:3, 3]
        return Mesh(points, self.normals @ turn.T, self.uv, self.faces)

    def wound(self) -> Mesh:
        """The same mesh, each face wound so that its right-hand normal agrees with its points'."""
        a, b, c = (self.points[self.faces[:, k]] for k in range(3))
        facing = np.einsum("fk,fk->f", np.cross(b - a, c - a), self.normals[self.faces[:, 0]])
        faces = np.where(facing[:, None] < 0, self.faces[:, ::-1], self.faces)
        return Mesh(self.points, self.normals, self.uv, faces)


def joined(meshes: Sequence[Mesh]) -> Mesh:
    starts = np.cumsum([0] + [len(mesh.points) for mesh in meshes])
    return Mesh(
        np.concatenate([mesh.points for mesh in meshes]),
        np.concatenate([mesh.normals for mesh in meshes]),
        np.concatenate([mesh.uv for mesh in meshes]),
        np.concatenate(
            [mesh.faces + start for mesh, start in zip(meshes, starts[:-1], strict=True)]
        ),
    )


def box(half_m: ArrayLike) -> Mesh:
    """Centred at the origin; `half_m` [3] is half its size."""
    half = np.asarray(half_m, float)
    sides = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            normal = np.zeros(3)
            normal[axis] = sign
            across, up = np.delete(np.arange(3), axis)
            size = half[across], half[up]
            side = sheet(*size)
            frame = np.zeros((4, 4))
            frame[across, 0] = frame[up, 1] = frame[3, 3] = 1
            frame[:3, 2] = np.cross(frame[:3, 0], frame[:3, 1])
            frame[:3, 3] = normal * half
            turned = side.moved(frame)
            sides.append(Mesh(turned.points, np.tile(normal, (4, 1)), side.uv, side.faces))
    return joined(sides)


def sheet(half_x_m: float, half_y_m: float) -> Mesh:
    """A rectangle in the plane z = 0 that faces -z."""
    return outline(np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (half_x_m, half_y_m))


def outline(xy_m: Matrix) -> Mesh:
    """A convex polygon [N, 2] in the plane z = 0 that faces -z."""
    count = len(xy_m)
    points = np.column_stack([xy_m, np.zeros(count)])
    fan = np.arange(1, count - 1)
    faces = np.stack([np.zeros_like(fan), fan, fan + 1], 1)
    return Mesh(points, np.tile([0, 0, -1.0], (count, 1)), np.asarray(xy_m, float), faces)


def leaf(length_m: float, width_m: float, *, bend: float = 0.4) -> Mesh:
    """A blade from the origin along +y that bends towards +z."""
    along = np.linspace(0, 1, 7)
    half = width_m / 2 * np.sin(np.pi * along**0.7) + 1e-4
    lift = bend * length_m * along**2
    points = np.concatenate(
        [np.stack([side * half, along * length_m, lift], 1) for side in (-1, 1)]
    )
    tangent = np.stack([np.zeros(7), np.ones(7), 2 * bend * along], 1)
    normal = np.cross(np.array([1.0, 0, 0]), tangent)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return Mesh(points, np.tile(-normal, (2, 1)), points[:, :2].copy(), _strip(7))


def lathe(profile_m: ArrayLike, *, around: int = _AROUND) -> Mesh:
    """A profile [N, 2] of (radius, y) turned about the y axis, smooth across it.

    y points down: a profile that starts at the top has outward normals.
    """
    profile = np.asarray(profile_m, float)
    rings = len(profile)
    angle = np.linspace(0, 2 * np.pi, around + 1)
    slope = np.gradient(profile, axis=0)
    outward = np.stack([slope[:, 1], -slope[:, 0]], 1)
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-12)
    radius, y = profile.T
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    turn = np.stack([np.cos(angle), np.sin(angle)], 1)
    points, normals, uv = [], [], []
    for k in range(rings):
        points.append(np.stack([radius[k] * turn[:, 0], np.full(around + 1, y[k]),
                                radius[k] * turn[:, 1]], 1))  # fmt: skip
        normals.append(np.stack([outward[k, 0] * turn[:, 0], np.full(around + 1, outward[k, 1]),
                                 outward[k, 0] * turn[:, 1]], 1))  # fmt: skip
        uv.append(np.stack([angle * radius.max(), np.full(around + 1, along[k])], 1))
    index = np.arange(around)
    faces = []
    for k in range(rings - 1):
        a, b = k * (around + 1) + index, (k + 1) * (around + 1) + index
        faces += [np.stack([a, b, a + 1], 1), np.stack([a + 1, b, b + 1], 1)]
    return Mesh(np.concatenate(points), np.concatenate(normals), np.concatenate(uv),
                np.concatenate(faces))  # fmt: skip


def post(radius_m: float, half_height_m: float, *, top: float = 1.0) -> Mesh:
    """An upright cylinder about the origin; `top` scales the upper radius."""
    upper = radius_m * top
    side = lathe([(upper, -half_height_m), (radius_m, half_height_m)])
    return joined([side, _disc(upper, -half_height_m, -1), _disc(radius_m, half_height_m, 1)])


def rod(start_m: ArrayLike, end_m: ArrayLike, radius_m: float) -> Mesh:
    """A cylinder between two points."""
    start, end = np.asarray(start_m, float), np.asarray(end_m, float)
    length = float(np.linalg.norm(end - start))
    frame = np.eye(4)
    frame[:3, :3] = turn_y_to((end - start) / length)
    frame[:3, 3] = (start + end) / 2
    return lathe([(radius_m, -length / 2), (radius_m, length / 2)], around=10).moved(frame)


def ball(half_m: ArrayLike) -> Mesh:
    """An ellipsoid about the origin."""
    half = np.asarray(half_m, float)
    angle = np.linspace(1e-3, np.pi - 1e-3, 14)
    unit = lathe(np.stack([np.sin(angle), -np.cos(angle)], 1))
    normals = unit.points / half
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Mesh(unit.points * half, normals, unit.uv * half.max(), unit.faces)


def turn_y_to(direction: Matrix) -> Matrix:
    """A rotation [3, 3] that takes the y axis to a unit vector."""
    side = np.array([0.0, 0, 1]) if abs(direction[2]) < 0.9 else np.array([1.0, 0, 0])
    x = np.cross(direction, side)
    x /= np.linalg.norm(x)
    return np.stack([x, direction, np.cross(x, direction)], axis=1)


def _disc(radius_m: float, y_m: float, facing: int) -> Mesh:
    angle = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    xz = radius_m * np.stack([np.cos(angle), np.sin(angle)], 1)
    flat = outline(xz)
    points = np.stack([xz[:, 0], np.full(_AROUND, y_m), xz[:, 1]], 1)
    return Mesh(points, np.tile([0.0, facing, 0], (_AROUND, 1)), flat.uv, flat.faces)


def _strip(count: int) -> NDArray[np.int64]:
    """Faces of two rows of points joined like a ladder."""
    a = np.arange(count - 1)
    b = a + count
    return np.concatenate([np.stack([a, b, a + 1], 1), np.stack([a + 1, b, b + 1], 1)])
