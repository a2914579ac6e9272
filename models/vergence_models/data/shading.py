"""Colours of hits: filtered texture, two lights, soft shadow, gloss and mirrored surroundings.

Everything works on flat lists of N samples, a chunk at a time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from vergence_models.data.raycast import to_local
from vergence_models.data.shapes import Shape
from vergence_models.data.textures import TextureBank

_CHUNK = 16384
_MAX_ANISOTROPY = 6.0
_SHADOW_BIAS = 0.008  # share of the distance to the light
_SHADOW_LIFT = 0.015  # likewise, along the surface's normal
FACES = 8  # surface index = primitive * FACES + face


@dataclass(frozen=True, slots=True, eq=False)
class Illumination:
    """Light of V views, as columns: lights in view axes, ambient light, sky, shadow map."""

    columns: Tensor  # float32 [C, V]; see `illumination_columns`
    shadow_depth_m: Tensor  # float32 [S, R, R], one map a scene
    scene: Tensor  # int64 [V], the scene of each view


# Rows of `Illumination.columns`: position 3 and colour 3 and 1 / reach^2 of each light, ambient 3,
# up 3 (view axes), world_from_view 9, light_from_view 12, shadow focal length 1 (in map pixels),
# sky texture 1, sky colour 3, footprint of a pixel at 1 m 1.
_LIGHTS = (0, 7)
_AMBIENT, _UP, _WORLD, _SHADOW, _SHADOW_FOCAL, _SKY, _PIXEL = 14, 17, 20, 29, 41, 42, 46


def shade(
    table: Tensor, light: Illumination, bank: TextureBank, m: Tensor, view: Tensor,
    ray_x: Tensor, ray_y: Tensor, depth_m: Tensor,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Linear RGB float32 [N, 3] and surface indices int64 [N] of samples along camera rays.

    `table` float32 [C, M] has for each primitive local_from_view 12, half_m 3, shape 1, material
    14; m int64 [N] is -1 for the sky.
    """
    samples = (m, view, ray_x, ray_y, depth_m)
    chunks = zip(*(torch.split(values, _CHUNK) for values in samples), strict=True)
    colors, surfaces = zip(*(_shade_chunk(table, light, bank, *c) for c in chunks), strict=True)
    return torch.cat(colors), torch.cat(surfaces)


def _shade_chunk(
    table: Tensor, light: Illumination, bank: TextureBank, m: Tensor, view: Tensor,
    x: Tensor, y: Tensor, t: Tensor,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    sky = m < 0
    rows = table.index_select(1, m.clamp(min=0))
    # Most chunks lie within one view, whose columns then broadcast.
    one_view = int(view[0]) == int(view[-1])
    by_view = light.columns.index_select(1, view[:1] if one_view else view)
    t = torch.where(sky, 1.0, t)
    origin, direction = to_local(rows[:12], x, y)
    half = rows[12:15]
    p = torch.stack([o + t * d for o, d in zip(origin, direction, strict=True)])
    shape, material = rows[15], rows[16:]
    normal_local = _gradient(shape, p)
    normal_metric = _unit(normal_local / half)
    normal = _normal_in_view(rows[:12], normal_local)
    ray = torch.stack([x, y, torch.ones_like(x)])
    ray_length = (x * x + y * y + 1).sqrt()
    against = _dot(normal, ray)
    normal = -normal * against.sign()
    cosine = (against.abs() / ray_length).clamp(min=0.02)

    albedo, face = _albedo(bank, p * half, torch.stack(direction) * half, normal_metric, material,
                           cosine, t * ray_length * by_view[_PIXEL])  # fmt: skip
    surface = torch.where(sky, -1, m * FACES + face)
    hit = ray * t
    color = _lit(albedo, hit, normal, -ray / ray_length, material, by_view, light, view)

    mirror = torch.where(sky, 1.0, material[12])
    shiny = mirror.nonzero()[:, 0]
    if len(shiny):
        n, r = normal[:, shiny], ray[:, shiny]
        bounced = r - 2 * _dot(n, r) * n
        looking = torch.where(sky[shiny], r, bounced)
        around = _surroundings(bank, looking, by_view if one_view else by_view[:, shiny])
        share = mirror[shiny]
        color[:, shiny] = color[:, shiny] * (1 - share) + around * share
    return color.t(), surface


def _normal_in_view(local_from_view: Tensor, normal_local: Tensor) -> Tensor:
    """Unit normals [3, N]: they follow the inverse transpose, that is the rows of the inverse."""
    a = local_from_view.view(3, 4, -1)
    along_x, along_y, along_z = (a[i, :3] * normal_local[i] for i in range(3))
    return _unit(along_x + along_y + along_z)


def view_normals(table: Tensor, m: Tensor, ray_x: Tensor, ray_y: Tensor, depth_m: Tensor) -> Tensor:
    """Unit normals [3, N] in view axes, towards the eye, where camera rays hit primitives m [N]."""
    rows = table.index_select(1, m)
    origin, direction = to_local(rows[:12], ray_x, ray_y)
    hit = torch.stack([o + depth_m * d for o, d in zip(origin, direction, strict=True)])
    normal = _normal_in_view(rows[:12], _gradient(rows[15], hit))
    ray = torch.stack([ray_x, ray_y, torch.ones_like(ray_x)])
    return -normal * _dot(normal, ray).sign()


def _gradient(shape: Tensor, p: Tensor) -> Tensor:
    """An outward normal in the canonical frame [3, N], of any length."""
    size = p.abs()
    largest = torch.maximum(torch.maximum(size[0], size[1]), size[2])
    is_x = size[0] >= largest
    is_y = (size[1] >= largest) & ~is_x
    faces = torch.stack([is_x, is_y, ~is_x & ~is_y]) * p.sign()
    cap = (size[2] > 0.9995).float()
    around = torch.stack([p[0] * (1 - cap), p[1] * (1 - cap), p[2] * cap])
    flat = torch.zeros_like(p)
    flat[2] = 1
    normal = torch.where(shape == Shape.BOX, faces, flat)
    normal = torch.where(shape == Shape.CYLINDER, around, normal)
    return torch.where(shape == Shape.ELLIPSOID, p, normal)


def _albedo(
    bank: TextureBank, p_m: Tensor, direction_m: Tensor, normal: Tensor, material: Tensor,
    cosine: Tensor, pixel_m: Tensor,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Reflectance [3, N] and face 0..5 [N]: each surface is mapped along its normal's main axis."""
    size = normal.abs()
    largest = torch.maximum(torch.maximum(size[0], size[1]), size[2])
    on_x = size[0] >= largest
    on_y = (size[1] >= largest) & ~on_x
    negative = torch.where(on_x, normal[0], torch.where(on_y, normal[1], normal[2])) < 0
    face = on_x.long() + 2 * on_y.long() + 3 * negative.long()

    tangent = direction_m - _dot(direction_m, normal) * normal

    def unwrap(vector: Tensor) -> tuple[Tensor, Tensor]:
        u = torch.where(on_x, vector[2], vector[0])
        return u, torch.where(on_y, vector[2], vector[1])

    u, v = unwrap(p_m)
    tangent_u, tangent_v = unwrap(tangent)
    texels = bank.size / material[1]
    minor = pixel_m * texels
    stretch = minor * torch.reciprocal(cosine).clamp(max=_MAX_ANISOTROPY)
    stretch = stretch * torch.rsqrt(tangent_u * tangent_u + tangent_v * tangent_v + 1e-12)
    shift = face * 0.37
    texture = bank.sample(
        material[0].long(),
        u * texels + (material[2] + shift) * bank.size,
        v * texels + (material[3] + shift) * bank.size,
        (tangent_u * stretch, tangent_v * stretch),
        minor,
    )
    tone = (material[7:10] + material[4:7] * texture.t()).clamp(0, 1)
    return tone * tone, face


def _lit(
    albedo: Tensor, hit: Tensor, normal: Tensor, to_eye: Tensor, material: Tensor, by_view: Tensor,
    light: Illumination, view: Tensor,
) -> Tensor:  # fmt: skip
    upward = _dot(normal, by_view[_UP : _UP + 3])
    received = by_view[_AMBIENT : _AMBIENT + 3] * (0.75 + 0.25 * upward)
    gloss = torch.zeros_like(hit)
    for index, start in enumerate(_LIGHTS):
        to_light = by_view[start : start + 3] - hit
        squared = _dot(to_light, to_light)
        to_light = to_light * torch.rsqrt(squared)
        strength = _dot(normal, to_light).clamp(min=0) / (1 + squared * by_view[start + 6])
        if index == 0:
            strength = strength * _unshadowed(hit, normal, by_view, light, view)
        arriving = by_view[start + 3 : start + 6] * strength
        received = received + arriving
        middle = _unit(to_light + to_eye)
        glint = _dot(normal, middle).clamp(min=1e-4) ** material[11]
        gloss = gloss + arriving * glint
    return albedo * (received + material[13]) + gloss * material[10]


def _unshadowed(
    hit: Tensor, normal: Tensor, by_view: Tensor, light: Illumination, view: Tensor
) -> Tensor:
    """The share of the first light that arrives, float32 [N]: 3x3 lookups around the hit."""
    resolution = light.shadow_depth_m.shape[-1]
    # Looked up a little above the surface, or surfaces nearly along the light shadow themselves.
    distance = (hit - by_view[:3]).abs().amax(0)
    lifted = hit + normal * (distance * _SHADOW_LIFT)
    x, y, z = to_local_point(by_view[_SHADOW : _SHADOW + 12], lifted)
    depth = z.clamp(min=1e-3)
    u = x / depth * by_view[_SHADOW_FOCAL] + (resolution - 1) / 2
    v = y / depth * by_view[_SHADOW_FOCAL] + (resolution - 1) / 2
    inside = (z > 0) & (torch.maximum((u - resolution / 2).abs(), (v - resolution / 2).abs())
                        < resolution / 2 - 2)  # fmt: skip
    u, v = u.clamp(1, resolution - 3), v.clamp(1, resolution - 3)
    u0, v0 = u.floor(), v.floor()
    fu, fv = u - u0, v - v0
    index = (light.scene.index_select(0, view) * resolution + v0.long()) * resolution + u0.long()
    near = depth * (1 - _SHADOW_BIAS)
    flat = light.shadow_depth_m.view(-1)
    weights_u, weights_v = (1 - fu, torch.ones_like(fu), fu), (1 - fv, torch.ones_like(fv), fv)
    lit = torch.zeros_like(u)
    for row, weight_v in zip((-1, 0, 1), weights_v, strict=True):
        for column, weight_u in zip((-1, 0, 1), weights_u, strict=True):
            seen = flat.index_select(0, index + (row * resolution + column)) >= near
            lit = lit + seen * (weight_u * weight_v)
    return torch.where(inside, lit * 0.25, 1.0)


def to_local_point(rows: Tensor, point: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Apply 3x4 transforms `rows` [12, N] to points [3, N]."""
    a = rows.view(3, 4, -1)
    x, y, z = (_dot(a[i, :3], point) + a[i, 3] for i in range(3))
    return x, y, z


# Reductions over a leading dimension of three are many times slower than these on a CPU.
def _dot(a: Tensor, b: Tensor) -> Tensor:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _unit(vector: Tensor) -> Tensor:
    return vector * torch.rsqrt(_dot(vector, vector) + 1e-20)


def _surroundings(bank: TextureBank, direction: Tensor, by_view: Tensor) -> Tensor:
    """The colour at infinity in a direction (view axes) [3, N]: the sky texture wrapped around."""
    world = by_view[_WORLD : _WORLD + 9].view(3, 3, -1)
    x, y, z = (_dot(world[i], direction) for i in range(3))
    azimuth = torch.atan2(x, z)
    elevation = torch.atan2(y, (x * x + z * z).sqrt())
    texels = bank.size / math.pi
    pixel = (by_view[_PIXEL] * texels).expand_as(azimuth)
    texture = bank.sample(
        by_view[_SKY].long().expand(len(azimuth)),
        azimuth * texels * 2,
        (elevation + math.pi / 2) * texels,
        (pixel * 2, torch.zeros_like(pixel)),
        pixel,
    )
    return texture.t() ** 2 * by_view[_SKY + 1 : _SKY + 4]
