"""Laws of the warp: true pose and disparity reproduce the next view; the nearest surface wins."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from vergence_models.networks.warp import (
    cell_centres,
    fill_cracks,
    inverse_4x4,
    splat_levels,
    splat_nearest,
    splat_softmax,
    transform_uvd,
    warp_state,
)
from vergence_proto.geometry import Pose, RectifiedRig, uvd_curr_from_prev

HEIGHT, WIDTH, SCALE = 192, 256, 4
RIG = RectifiedRig(WIDTH, HEIGHT, 200.0, 205.0, 127.0, 127.0, 95.0, 0.1)
MOTIONS = {
    "still": ((0, 0, 0), (0, 0, 0)),
    "turn right": ((0, 0.05, 0), (0, 0, 0)),
    "look up": ((0.04, 0, 0), (0, 0, 0)),
    "roll": ((0, 0, 0.06), (0, 0, 0)),
    "step forward": ((0, 0, 0), (0, 0, 0.12)),
    "step aside": ((0, 0, 0), (0.1, 0.02, 0)),
    "all at once": ((0.02, -0.04, 0.03), (0.05, -0.03, 0.06)),
}


def pose(rotation_xyz: tuple[float, ...], translation_m: tuple[float, ...]) -> Pose:
    quaternion = np.array([*(np.array(rotation_xyz) / 2), 1.0])
    return Pose.from_xyzw(quaternion, np.array(translation_m, np.float64))


def wall_disparity(world_from_left: Pose, scale: int) -> Tensor:
    """Disparity at cells of a slanted wall that fills the view: [1, H/s, W/s]."""
    normal, distance_m = np.array([0.2, -0.1, 1.0]), 2.0
    u = np.arange(WIDTH // scale) * scale + (scale - 1) / 2
    v = np.arange(HEIGHT // scale)[:, None] * scale + (scale - 1) / 2
    rays = np.stack(
        np.broadcast_arrays((u - RIG.cx_left) / RIG.fx, (v - RIG.cy) / RIG.fy, 1.0), axis=-1
    )
    directions = rays @ world_from_left.rotation.T
    depth_m = (distance_m - normal @ world_from_left.translation_m) / (directions @ normal)
    return torch.from_numpy(RIG.fx * RIG.baseline_m / depth_m).float()[None]


@pytest.mark.parametrize("name", MOTIONS)
def test_true_pose_and_disparity_reproduce_the_next_view(name: str) -> None:
    world_from_curr = pose(*MOTIONS[name])
    curr_from_prev = world_from_curr.inverse()  # the previous camera is the world's origin
    matrix = torch.from_numpy(uvd_curr_from_prev(RIG, curr_from_prev))[None]
    before = wall_disparity(Pose.identity(), SCALE)[:, None]
    after = wall_disparity(world_from_curr, SCALE)
    column = torch.arange(WIDTH // 8).float().expand(1, 1, HEIGHT // 8, WIDTH // 8)
    prior, hidden = warp_state(before, column, matrix, scale=SCALE, hidden_scale=8)
    seen = prior[:, 0] > 0
    assert seen.float().mean() > 0.75
    inner = torch.zeros_like(seen)
    inner[:, 3:-3, 3:-3] = seen[:, 3:-3, 3:-3]  # beyond the old view's rim nothing is known
    error = (prior[:, 0] - after).abs()[inner]
    # Cells are 4 px wide: what is left is the error of bilinear sampling on a slanted wall.
    assert error.mean() < 0.01
    assert error.quantile(0.99) < 0.05

    # The hidden state holds its own column: it must have come from the cell that lies nearest to
    # where the geometry says.
    u, v = cell_centres(HEIGHT // 8, WIDTH // 8, 8, prior)
    back = torch.linalg.inv(matrix.double()).float()
    u_from, _, _ = transform_uvd(back, u, v, wall_disparity(world_from_curr, 8))
    expected = (u_from + 0.5) / 8 - 0.5
    inside = (expected > 1) & (expected < WIDTH // 8 - 2)
    inside[:, :2] = inside[:, -2:] = False
    known = inside & (hidden[:, 0] > 0)
    assert known.float().mean() > 0.6
    assert (hidden[:, 0] - torch.floor(expected + 0.5)).abs()[known].mean() < 0.05


@pytest.mark.parametrize("name", MOTIONS)
def test_splatting_by_softmax_reproduces_the_next_view_too(name: str) -> None:
    world_from_curr = pose(*MOTIONS[name])
    matrix = torch.from_numpy(uvd_curr_from_prev(RIG, world_from_curr.inverse()))[None]
    before = wall_disparity(Pose.identity(), 8)[:, None]
    columns = [
        torch.arange(WIDTH // scale).float().expand(1, 1, HEIGHT // scale, WIDTH // scale)
        for scale in (8, 16)
    ]
    (prior, seen), *hidden = splat_levels(before, tuple(columns), matrix, scale=8)
    inner = torch.zeros_like(seen, dtype=torch.bool)
    inner[..., 2:-2, 2:-2] = seen[..., 2:-2, 2:-2] > 0
    assert inner.float().mean() > 0.6
    # Four cells of 8 px share each value: a slanted wall is smoothed by their spread.
    error = (prior - wall_disparity(world_from_curr, 8)[:, None]).abs()[inner]
    assert error.mean() < 0.05
    assert error.quantile(0.99) < 0.2

    back = torch.linalg.inv(matrix.double()).float()
    for scale, (values, known) in zip((8, 16), hidden, strict=True):
        height, width = values.shape[2:]
        u, v = cell_centres(height, width, scale, values)
        u_from, _, _ = transform_uvd(back, u, v, wall_disparity(world_from_curr, scale))
        expected = (u_from + 0.5) / scale - 0.5
        inside = (known[:, 0] > 0) & (expected > 1) & (expected < values.shape[3] - 2)
        assert inside.float().mean() > 0.5
        assert (values[:, 0] - expected).abs()[inside].mean() < 0.1


def test_a_still_camera_splats_everything_where_it_was() -> None:
    before = wall_disparity(Pose.identity(), 8)[:, None]
    hidden = torch.randn(1, 5, *before.shape[2:]), torch.randn(1, 3, 12, 16)
    warped = splat_levels(before, hidden, torch.eye(4)[None], scale=8)
    for (values, seen), expected in zip(warped, (before, *hidden), strict=True):
        assert torch.allclose(values, expected, atol=1e-4)
        assert (seen == 1).all()


def test_the_nearest_wins_by_softmax_and_far_surfaces_are_not_lost() -> None:
    d = torch.tensor([[[5.0, 30.0, 6.0, 0.0]]])
    column = torch.tensor([[[1.0, 1.0, 3.0, 0.0]]])
    values, seen = splat_softmax(d[:, None], column, torch.zeros_like(column), d)
    assert values.flatten().tolist() == pytest.approx([0.0, 30.0, 0.0, 6.0], abs=1e-4)
    assert seen.flatten().tolist() == [0, 1, 0, 1]


def test_where_two_surfaces_land_the_nearest_wins() -> None:
    d = torch.tensor([[[5.0, 9.0, 7.0, 0.0]]])
    column = torch.tensor([[[1.0, 1.0, 1.0, 3.0]]])
    landed = splat_nearest(d, column, torch.zeros_like(column))
    assert landed.tolist() == [[[0.0, 9.0, 0.0, 0.0]]]


def test_what_leaves_the_view_lands_nowhere() -> None:
    d = torch.full((1, 1, 3), 4.0)
    column = torch.tensor([[[-1.0, 3.0, 1.0]]])
    row = torch.tensor([[[0.0, 0.0, 1.0]]])
    assert splat_nearest(d, column, row).sum() == 0


def test_cracks_close_and_holes_stay_open() -> None:
    d = torch.full((1, 7, 9), 3.0)
    d[:, :, 2] = 0  # a crack
    d[:, :, 5:] = 0  # a hole
    filled = fill_cracks(d)
    assert filled[0, 3, 2] == pytest.approx(3.0)
    assert (filled[0, :, 6:] == 0).all()


def test_a_cold_state_is_a_hole_everywhere() -> None:
    prior, hidden = warp_state(
        torch.zeros(2, 1, 48, 64),
        torch.ones(2, 8, 24, 32),
        torch.eye(4).repeat(2, 1, 1),
        scale=4,
        hidden_scale=8,
    )
    assert (prior == 0).all()
    assert (hidden == 0).all()


def test_the_inverse_keeps_sub_pixel_accuracy_at_pixel_sized_entries() -> None:
    matrix = torch.from_numpy(uvd_curr_from_prev(RIG, pose(*MOTIONS["all at once"])))[None]
    product = matrix.double() @ inverse_4x4(matrix.double())
    assert (product - torch.eye(4, dtype=torch.float64)).abs().max() < 1e-9
