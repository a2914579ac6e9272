"""From shots to clips: poses of every primitive in every view, visibility, colour, ground truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vergence_models.data import scenes
from vergence_models.data.clips import StereoClips
from vergence_models.data.raycast import Cameras, Primitives, RayHits, cast, intersect_rays
from vergence_models.data.shading import FACES, Illumination, shade
from vergence_models.data.shapes import Shape
from vergence_models.data.textures import TextureBank
from vergence_models.data.views import Shot, both_eyes, column, in_views, padded_rows

_SHADOW_RESOLUTION = 256
# Four samples of an edge pixel, on a rotated grid: nearly vertical and horizontal edges both get
# four steps of coverage.
_SAMPLES = ((-0.125, -0.375), (0.375, -0.125), (0.125, 0.375), (-0.375, 0.125))
_GAMMA = 1 / 2.2
_BRIGHTEST = 2.0  # a highlight brighter than this would swallow the edge it is on


def render(
    shots: list[Shot], bank: TextureBank, *, width: int, height: int,
    device: torch.device | str = "cpu",
) -> StereoClips:  # fmt: skip
    """Film shots of one length into one batch of clean clips on a device."""
    count, frames = len(shots), len(shots[0].times_s)
    world_from_left = torch.from_numpy(np.stack([s.world_from_left for s in shots])).to(device)
    baseline = column([s.baseline_m for s in shots], device)
    world_from_view = both_eyes(world_from_left, baseline.double())  # [B, T, 2, 4, 4]
    rows = padded_rows(shots, device)
    primitives, table = in_views(rows, shots, world_from_view)

    def per_view(values: list[float]) -> Tensor:
        return column(values, device).repeat_interleave(frames * 2)

    focal = per_view([s.focal_px for s in shots])
    cx, cy = per_view([s.cx for s in shots]), per_view([s.cy for s in shots])
    cameras = Cameras(focal, focal, cx, cy, width, height)
    hits = cast(primitives, cameras)
    light = _illumination(rows, shots, world_from_view, focal)
    color = _color(primitives, table, cameras, hits, light, bank)
    color = color.view(count, frames * 2, height, width, 3)
    image = _develop(color, shots).view(count, frames, 2, height, width, 3)

    disparity = (focal * per_view([s.baseline_m for s in shots]))[:, None, None] / hits.depth_m
    disparity = disparity.view(count, frames, 2, height, width)
    first = per_view([s.focal_px for s in shots])[:: frames * 2]
    return StereoClips(
        left=image[:, :, 0],
        right=image[:, :, 1],
        disparity_px=disparity[:, :, 0].contiguous(),
        visible=_visible_in_right(disparity[:, :, 0], disparity[:, :, 1]),
        world_from_left=world_from_left,
        fx=first,
        fy=first.clone(),
        cx=column([s.cx for s in shots], device),
        cy=column([s.cy for s in shots], device),
        baseline_m=baseline,
    )


def _illumination(
    rows: Tensor, shots: list[Shot], world_from_view: Tensor, focal: Tensor
) -> Illumination:
    device = rows.device
    count, frames = world_from_view.shape[:2]
    view_from_world = world_from_view.inverse().view(count, frames * 2, 4, 4)
    shadow, world_from_light, shadow_focal = _shadow_maps(rows, shots)

    def numbers(values: list[NDArray[np.float64]]) -> Tensor:
        return torch.from_numpy(np.stack(values)).to(device)

    columns = []  # each [B, V per scene, n]
    for which in range(2):
        position = numbers([s.scene.lights[which].position_m for s in shots])
        seen = view_from_world[..., :3, :3] @ position[:, None, :, None]
        columns.append((seen + view_from_world[..., :3, 3:])[..., 0])
        color = [
            np.append(s.scene.lights[which].color, s.scene.lights[which].reach_m ** -2.0)
            for s in shots
        ]
        columns.append(numbers(color)[:, None].expand(-1, frames * 2, -1))
    columns.append(numbers([s.scene.ambient for s in shots])[:, None].expand(-1, frames * 2, -1))
    columns.append(-view_from_world[..., :3, 1])  # up is world -y
    world = world_from_view.view(count, frames * 2, 4, 4)
    columns.append(world[..., :3, :3].flatten(2))
    light_from_view = world_from_light.inverse()[:, None] @ world
    columns.append(light_from_view[..., :3, :].flatten(2))
    sky = [
        np.array([shadow_focal[b], s.scene.sky_texture, *s.scene.sky_color])
        for b, s in enumerate(shots)
    ]
    columns.append(numbers(sky)[:, None].expand(-1, frames * 2, -1))
    columns.append(1 / focal.view(count, -1, 1).double())
    flat = torch.cat(columns, dim=-1).flatten(0, 1).t().float().contiguous()
    scene = torch.arange(count, device=device).repeat_interleave(frames * 2)
    return Illumination(flat, shadow, scene)


def _shadow_maps(rows: Tensor, shots: list[Shot]) -> tuple[Tensor, Tensor, list[float]]:
    """Depth from each scene's first light: maps [B, R, R], world_from_light [B, 4, 4], focals.

    Things that move or glow cast none: the map is drawn once a shot.
    """
    resolution, poses, focals = _SHADOW_RESOLUTION, [], []
    for shot in shots:
        pose = np.eye(4)
        position = shot.scene.lights[0].position_m
        pose[:3, :3] = scenes.look_along(shot.scene.shadow_target_m - position)
        pose[:3, 3] = position
        poses.append(pose)
        focals.append(resolution / 2 / np.tan(shot.scene.shadow_half_angle_rad))
    world_from_light = torch.from_numpy(np.stack(poses)).to(rows.device)
    still = rows.clone()
    moves = (rows[..., scenes.VELOCITY_M_S.start : scenes.SPIN_RAD_S.stop] != 0).any(-1)
    glows = rows[..., scenes.MATERIAL.stop - 1] > 0
    shape = rows[..., scenes.SHAPE]
    still[..., scenes.SHAPE] = torch.where(moves | glows, float(Shape.PAD), shape)
    # A light has one view where the rig has two per frame; its second is dropped again.
    eyes = world_from_light[:, None, None].expand(-1, 1, 2, -1, -1)
    both, _ = in_views(still, [replace(s, times_s=np.zeros(1)) for s in shots], eyes)
    keep = torch.arange(len(both.shape), device=rows.device).view(len(shots), 2, -1)[:, 0].flatten()
    single = Primitives(
        both.shape[keep], both.local_from_view[:, keep], both.view_from_local[keep],
        both.taper[keep], both.cutout[keep], len(shots),
    )  # fmt: skip
    focal = torch.tensor(focals, dtype=torch.float32, device=rows.device)
    middle = torch.full_like(focal, (resolution - 1) / 2)
    cameras = Cameras(focal, focal, middle, middle, resolution, resolution)
    return cast(single, cameras).depth_m, world_from_light, focals


def _color(
    primitives: Primitives, table: Tensor, cameras: Cameras, hits: RayHits, light: Illumination,
    bank: TextureBank,
) -> Tensor:  # fmt: skip
    """Linear RGB [V, H, W, 3]: one sample a pixel, and four where a surface ends."""
    views, height, width = hits.primitive.shape
    pixel = torch.arange(views * height * width, device=hits.depth_m.device)

    def rays(at: Tensor, du: Tensor | float, dv: Tensor | float) -> tuple[Tensor, Tensor, Tensor]:
        view = at // (height * width)
        u, v = at % width + du, at // width % height + dv
        x = (u - cameras.cx[view]) / cameras.fx[view]
        return view, x, (v - cameras.cy[view]) / cameras.fy[view]

    view, x, y = rays(pixel, 0.0, 0.0)
    color, surface = shade(
        table, light, bank, hits.primitive.flatten(), view, x, y, hits.depth_m.flatten()
    )
    around = _neighbours(surface.view(views, height, width))  # [5, V * H * W]
    edge = (around[1:] != around[:1]).any(0).nonzero()[:, 0]
    candidates = torch.where(around[:, edge] < 0, -1, around[:, edge] // FACES)
    # A sample takes the colour of the nearest pixel that shows its surface: visibility is sampled
    # four times, but shading, which textures have filtered already, is done once a pixel.
    places = torch.stack([edge + step for step in (0, -1, 1, -width, width)])
    own = color.clamp(max=_BRIGHTEST)
    nearby = own[places.clamp(0, len(own) - 1)]  # [5, N, 3]
    offsets = torch.tensor(_SAMPLES, device=color.device)
    _, x, y = rays(edge[:, None], offsets[:, 0], offsets[:, 1])
    source = _nearest_of(primitives, candidates, x, y)  # [N, samples]
    chosen = nearby.permute(1, 0, 2).gather(1, source[..., None].expand(-1, -1, 3))
    color[edge] = chosen.mean(1)
    return color.view(views, height, width, 3)


def _neighbours(surface: Tensor) -> Tensor:
    """A pixel's own surface and those left, right, above and below it: [5, V * H * W]."""
    left, right, above, below = (surface.clone() for _ in range(4))
    left[:, :, 1:], right[:, :, :-1] = surface[:, :, :-1], surface[:, :, 1:]
    above[:, 1:], below[:, :-1] = surface[:, :-1], surface[:, 1:]
    return torch.stack([surface, left, right, above, below]).flatten(1)


def _nearest_of(primitives: Primitives, candidates: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """The index of the first of K candidates [K, N] that rays [N, S] hit; 0 if they hit none."""
    depth = torch.full(x.shape, float("inf"), device=x.device)
    # Candidate -1 is the sky, behind everything; the pixel's own stands in where there is none.
    backdrop = torch.zeros_like(candidates[0])
    for k in range(len(candidates) - 1, -1, -1):
        backdrop = torch.where(candidates[k] < 0, k, backdrop)
    nearest = backdrop[:, None].repeat(1, x.shape[1])
    for k, candidate in enumerate(candidates):
        fresh = candidate >= 0
        for earlier in candidates[:k]:
            fresh &= candidate != earlier
        shapes = torch.where(fresh, primitives.shape[candidate.clamp(min=0)], -1)
        for shape in (Shape.QUAD, Shape.BOX, Shape.ELLIPSOID, Shape.CYLINDER):
            at = (shapes == shape).nonzero()[:, 0]
            if len(at):
                ray_x, ray_y = x.index_select(0, at), y.index_select(0, at)
                t = intersect_rays(primitives, shape, candidate[at], ray_x, ray_y)
                known = depth.index_select(0, at)
                depth[at] = torch.minimum(t, known)
                nearest[at] = torch.where(t < known, k, nearest.index_select(0, at))
    return nearest


def _develop(color: Tensor, shots: list[Shot]) -> Tensor:
    """Linear RGB [B, V, H, W, 3] to uint8: one exposure a clip, a soft shoulder, gamma."""
    # The last left view sets it: clips that end with one view show it alike (see shots.Playback).
    brightness = color[:, -2:-1].mean(dim=(1, 2, 3, 4)).clamp(min=1e-3)
    aim = column([s.scene.exposure for s in shots], color.device)
    exposed = color * (aim / brightness)[:, None, None, None, None]
    # The shoulder maps 4 to 1 and hardly touches what is below one half.
    rolled = exposed * (1 + exposed / 16) / (1 + exposed)
    return (rolled.clamp(0, 1).pow(_GAMMA) * 255 + 0.5).to(torch.uint8)


def _visible_in_right(left: Tensor, right: Tensor) -> Tensor:
    """A mask of left pixels whose surface point the right eye sees: bool, as `left`.

    Between two neighbouring pixels of the right image a plane's disparity is linear, so a point is
    hidden only where both of them are nearer than it.
    """
    width = left.shape[-1]
    u = torch.arange(width, device=left.device) - left
    inside = (u >= 0) & (u <= width - 1)
    u0 = u.floor().clamp(0, width - 1).long()
    u1 = (u0 + 1).clamp(max=width - 1)
    seen = torch.minimum(right.gather(-1, u0), right.gather(-1, u1))
    slack_px = 0.25  # curved surfaces, and rounding
    return inside & (seen <= left + slack_px) & (left > 0)
