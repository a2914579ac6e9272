"""Laws of what is rendered: disparity, flow and visibility are those of geometry."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.support.tiny_scenes import (
    BASELINE_M,
    FOCAL_PX,
    PAINT,
    agreement,
    film,
    furnished_room,
    furnished_shot,
    pixel_rays,
    reprojected,
    still_life,
)
from vergence_models.data.clips import StereoClips
from vergence_models.data.generator import ClipGenerator
from vergence_models.data.render import render
from vergence_models.data.scenes import Builder
from vergence_models.data.shapes import Cutout, Shape, intersect
from vergence_models.data.truth import surface_truth

# Depth is a quotient of float32 sums of a few terms.
FLOAT32 = 2e-5


def test_disparity_of_a_wall_and_a_floor_is_focal_length_times_baseline_over_depth(
    generator: ClipGenerator,
) -> None:
    b = Builder()
    b.wall((0, 0, 4.0), 50, 50, PAINT)
    b.floor((0, 1.3, 0), 50, 50, PAINT)
    _, y = pixel_rays()
    depth_m = np.minimum(4.0, np.where(y > 0, 1.3 / np.maximum(y, 1e-9), np.inf))
    expected = FOCAL_PX * BASELINE_M / depth_m
    np.testing.assert_allclose(film(still_life(b), generator.bank), expected, rtol=FLOAT32)


def test_disparity_of_a_ball_is_that_of_its_nearer_side(generator: ClipGenerator) -> None:
    b = Builder()
    center, radius = np.array([0.2, -0.1, 2.5]), 0.6
    b.ball(center, (radius,) * 3, PAINT)
    x, y = pixel_rays()
    ray = np.stack([x, y, np.ones_like(x)], -1)
    along = ray @ center / (ray**2).sum(-1)
    miss_squared = ((ray * along[..., None] - center) ** 2).sum(-1)
    reach = np.sqrt(np.maximum(radius**2 - miss_squared, 0) / (ray**2).sum(-1))
    expected = np.where(miss_squared < radius**2, FOCAL_PX * BASELINE_M / (along - reach), 0)
    grazing = np.abs(miss_squared - radius**2) < 1e-3  # there the root amplifies rounding
    found = film(still_life(b), generator.bank)
    np.testing.assert_allclose(found[~grazing], expected[~grazing], rtol=1e-4)
    assert found.max() > 0


@pytest.mark.parametrize("shape", [Shape.QUAD, Shape.BOX, Shape.ELLIPSOID, Shape.CYLINDER])
def test_hits_lie_on_the_surface_and_are_the_first(shape: Shape) -> None:
    rng = np.random.default_rng(shape.value)
    start = torch.tensor([1.7, -2.1, 3.0])[:, None, None]
    aim = torch.from_numpy(rng.uniform(-1.2, 1.2, (3, 1, 4000)).astype(np.float32))
    origin = (start[0], start[1], start[2])
    direction = (aim[0] - start[0], aim[1] - start[1], aim[2] - start[2])
    taper = torch.full((1, 1), 0.4 if shape is Shape.CYLINDER else 0.0)
    full = torch.full((1, 1), float(Cutout.FULL))
    t = intersect(shape, origin, direction, taper=taper, cutout=full)
    hit = torch.isfinite(t)
    assert 0.1 < hit.float().mean() < 1

    def outside(t: Tensor) -> Tensor:
        """Negative inside the solid, zero on its surface."""
        x, y, z = (o + t * d for o, d in zip(origin, direction, strict=True))
        if shape is Shape.QUAD:
            return torch.stack([z.abs(), x.abs() - 1, y.abs() - 1]).amax(0)
        if shape is Shape.BOX:
            return torch.stack([x.abs(), y.abs(), z.abs()]).amax(0) - 1
        if shape is Shape.ELLIPSOID:
            return x * x + y * y + z * z - 1
        around = (x * x + y * y).sqrt() - (1 + 0.4 * z)
        return torch.maximum(around, z.abs() - 1)

    assert outside(t)[hit].abs().max() < 1e-4
    steps = torch.linspace(0, 1.6, 400)[:, None]
    before = torch.where(hit, t - 1e-3, 1.6)
    touched = outside(steps * torch.ones_like(t)) < -1e-3
    assert not (touched & (steps < before)).any()


def test_pose_and_disparity_predict_the_next_frames_disparity(generator: ClipGenerator) -> None:
    clips = furnished_room(generator.bank)
    assert agreement(clips, 0) > 0.96  # the rest has just been covered by something nearer
    still = torch.eye(4, dtype=torch.float64).expand(1, 4, 4, 4)
    fields = {name: getattr(clips, name) for name in StereoClips.__slots__}
    assert agreement(StereoClips(**{**fields, "world_from_left": still}), 0) < 0.8


def test_flow_of_a_still_scene_is_that_of_pose_and_disparity(generator: ClipGenerator) -> None:
    shot = furnished_shot()
    clips = render([shot], generator.bank, width=128, height=96)
    truth = surface_truth([shot], width=128, height=96)
    v, u = torch.meshgrid(torch.arange(96.0), torch.arange(128.0), indexing="ij")
    for frame in range(3):
        next_u, next_v, disparity = reprojected(clips, 0, frame)
        expected = torch.stack([next_u - u, next_v - v, disparity])
        found = torch.cat([truth.flow_px[0, frame], truth.next_disparity_px[0, frame][None]])
        assert (found - expected).abs().max() < 5e-3  # px: float32 through two matrices


def test_a_travelling_ball_takes_its_pixels_along() -> None:
    b = Builder()
    center, velocity = np.array([0.0, 0.0, 2.0]), np.array([0.9, -0.6, 0.3])
    b.moving(velocity).ball(center, (0.5,) * 3, PAINT)
    truth = surface_truth([still_life(b, poses=np.stack([np.eye(4)] * 2))], width=128, height=96)
    x, y = pixel_rays()
    middle = (48, 64)
    ray = np.array([x[middle], y[middle], 1.0])
    along = ray @ center / (ray @ ray)
    reach = np.sqrt((0.25 - ((ray * along - center) ** 2).sum()) / (ray @ ray))
    here = ray * (along - reach)
    there = here + velocity / 30
    expected = FOCAL_PX * (there[:2] / there[2] - here[:2] / here[2])
    np.testing.assert_allclose(truth.flow_px[0, 0, :, 48, 64].numpy(), expected, atol=1e-3)
    outward = (here - center) / 0.5
    np.testing.assert_allclose(truth.normals[0, 0, :, 48, 64].numpy(), outward, atol=1e-3)
    assert truth.flow_px[0, 0, :, 0, 0].isnan().all()


def test_what_stands_behind_a_near_thing_is_hidden_beside_it(generator: ClipGenerator) -> None:
    b = Builder()
    b.wall((0, 0, 4.0), 50, 50, PAINT)  # 3 px
    b.wall((0, 0, 1.0), 0.2, 5, PAINT)  # 12 px, columns 43.5 to 83.5 of the left image
    visible = render([still_life(b)], generator.bank, width=128, height=96).visible[0, 0, 48]
    hidden = (~visible).nonzero()[:, 0].tolist()
    # The strip hides 9 columns at its left; 3 more see past the right image's border.
    assert hidden == [0, 1, 2, *range(35, 44)]
