"""Every ground truth of a frame, from what its rays meet first.

All of it belongs to the clean camera at mid-exposure. Infinitely far pixels (the sky) have an
infinite depth, a disparity of zero and a flow by rotation alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from vergence_models.data.xrbench.meshes import Matrix
from vergence_models.data.xrbench.things import Room
from vergence_models.data.xrbench.tracer import FirstHits, Optics

Plane = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """The position in another frame of the points that pixels see; NaN behind that camera."""

    flow_px: Plane  # [H, W, 2]: then minus now
    depth_m: Plane  # [H, W]: then, along the optical axis


class Box(TypedDict):
    """One object in one frame. Pixels as drawn: the last column and row belong to the box."""

    label: int
    name: str
    pixels: int
    left: int
    top: int
    right: int
    bottom: int
    world_from_object: list[list[float]]  # [4, 4], world axes: x right, y down, z forward
    low_m: list[float]  # the corners of its box in its own frame
    high_m: list[float]


def rays(optics: Optics) -> Plane:
    """Unit vectors [H, W, 3] through pixel centres, OpenCV camera axes."""
    v, u = np.mgrid[: optics.height, : optics.width].astype(np.float64)
    x = (u - (optics.width - 1) / 2) / optics.focal_px
    y = (v - (optics.height - 1) / 2) / optics.focal_px
    directions = np.stack([x, y, np.ones_like(x)], -1)
    return _f32(directions / np.linalg.norm(directions, axis=-1, keepdims=True))


def depth_m(hits: FirstHits, world_from_camera: Matrix) -> Plane:
    """Metres [H, W] along the optical axis."""
    z = (hits.points_m - world_from_camera[:3, 3]) @ world_from_camera[:3, 2]
    return _f32(np.where(hits.label > 0, z, np.inf))


def disparity_px(depth: Plane, focal_px: float, baseline_m: float) -> Plane:
    """Positive pixels [H, W], in either view."""
    return _f32(focal_px * baseline_m / depth)


def normals(hits: FirstHits, world_from_camera: Matrix) -> Plane:
    """Unit vectors [H, W, 3], camera axes, towards the camera; zero for the sky."""
    to_camera = world_from_camera[:3, 3] - hits.points_m
    away = np.einsum("hwk,hwk->hw", hits.normals, to_camera) < 0
    facing = np.where(away[..., None], -hits.normals, hits.normals)
    turned = facing @ world_from_camera[:3, :3]
    length = np.linalg.norm(turned, axis=-1, keepdims=True)
    return _f32(np.where(hits.label[..., None] > 0, turned / np.maximum(length, 1e-9), 0))


def motion(
    hits: FirstHits,
    room: Room,
    optics: Optics,
    now: tuple[float, Matrix],
    then: tuple[float, Matrix],
) -> Motion:
    """Follow every pixel's point, on still and on moving things, hidden or not.

    `now` and `then` are a time in seconds and world_from_camera at it.
    """
    (now_s, world_from_now), (then_s, world_from_then) = now, then
    points = hits.points_m.copy()
    for index, thing in enumerate(room.things):
        if thing.moves:
            mine = hits.label == index + 1
            moved = thing.pose(then_s) @ np.linalg.inv(thing.pose(now_s))
            points[mine] = points[mine] @ moved[:3, :3].T + moved[:3, 3]
    seen = (points - world_from_then[:3, 3]) @ world_from_then[:3, :3]
    sky = hits.label == 0
    seen[sky] = rays(optics)[sky] @ world_from_now[:3, :3].T @ world_from_then[:3, :3]
    z = np.where(seen[..., 2] > 0, seen[..., 2], np.nan)
    v, u = np.mgrid[: optics.height, : optics.width]
    there = seen[..., :2] * (optics.focal_px / z)[..., None]
    here = np.stack([u - (optics.width - 1) / 2, v - (optics.height - 1) / 2], -1)
    return Motion(_f32(there - here), _f32(np.where(sky, np.inf, z)))


def boxes(hits: FirstHits, room: Room, time_s: float) -> list[Box]:
    """The tightest box around each thing that at least one pixel sees, and its pose."""
    found: list[Box] = []
    for label in np.unique(hits.label[hits.label > 0]).tolist():
        v, u = np.nonzero(hits.label == label)
        if label <= len(room.things):
            thing = room.things[label - 1]
            name, pose, (low, high) = thing.name, thing.pose(time_s), thing.bounds_m()
        else:
            lamp = room.lamps[label - 1 - len(room.things)]
            name, pose = lamp.name, lamp.world_from_panel
            high = np.array([*lamp.half_m, 0.0])
            low = -high
        found.append(
            Box(
                label=label, name=name, pixels=len(u),
                left=int(u.min()), top=int(v.min()), right=int(u.max()), bottom=int(v.max()),
                world_from_object=pose.tolist(), low_m=low.tolist(), high_m=high.tolist(),
            )
        )  # fmt: skip
    return found


def _f32(values: NDArray[np.floating]) -> Plane:
    return np.asarray(values, np.float32)
