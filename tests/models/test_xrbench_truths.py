"""The laws that the benchmark's ground truths obey, on the room where things move."""

from __future__ import annotations

import json
from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from vergence_models.data.xrbench import truths
from vergence_models.data.xrbench.camera import Eye, FrameTruth, StereoCamera
from vergence_models.data.xrbench.recipe import Recipe
from vergence_proto.geometry import Pose, RectifiedRig, uvd_curr_from_prev

pytestmark = pytest.mark.slow  # it renders with a path tracer

# Ten times the head's speed, so that frames differ by pixels in pictures this small.
RECIPE = Recipe("playroom", speed=10, width=96, height=72, fov_deg=60)
FRAMES = (0, 1, 2)
MOVING = ("ball", "box", "balloon")

# Depth comes from float32 positions a few metres from the origin.
EXACT_PX = 1e-3
# Between pixel centres a smooth surface bends, and inverse depth is interpolated straight.
INTERPOLATED_PX = 0.03


@cache
def camera() -> StereoCamera:
    return StereoCamera(RECIPE, variant="scalar_rgb")


@cache
def truth(frame: int) -> FrameTruth:
    return camera().truth(frame)


def pixels() -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    v, u = np.mgrid[: RECIPE.height, : RECIPE.width].astype(np.float32)
    return u, v


def label_of(name: str) -> int:
    return 1 + [thing.name for thing in camera().room.things].index(name)


def is_moving(frame: int) -> NDArray[np.bool_]:
    return np.isin(truth(frame).label, [label_of(name) for name in MOVING])


def sampled(plane: NDArray[np.float32], u: NDArray[np.float32], v: NDArray[np.float32],
            label: NDArray[np.uint16], of: NDArray[np.uint16]) -> NDArray[np.float32]:  # fmt: skip
    """`plane` between pixels; NaN where the four around are not all of the object `of`."""
    inside = (u >= 0) & (v >= 0) & (u <= RECIPE.width - 1) & (v <= RECIPE.height - 1)
    safe_u, safe_v = (np.where(np.isfinite(x), x, 0).clip(0, 1e4) for x in (u, v))
    values = np.asarray(cv2.remap(plane, safe_u, safe_v, cv2.INTER_LINEAR))
    for du in (0, 1):
        for dv in (0, 1):
            x = np.minimum(safe_u.astype(int) + du, RECIPE.width - 1)
            y = np.minimum(safe_v.astype(int) + dv, RECIPE.height - 1)
            inside &= label[np.minimum(y, RECIPE.height - 1), np.minimum(x, RECIPE.width - 1)] == of
    return np.where(inside, values, np.float32(np.nan))


def test_the_left_disparity_is_focal_length_times_baseline_over_depth() -> None:
    for frame in FRAMES:
        here = truth(frame)
        finite = np.isfinite(here.depth_m)
        product = here.disparity_px * here.depth_m
        expected = RECIPE.focal_px * RECIPE.baseline_m
        np.testing.assert_allclose(product[finite], expected, rtol=1e-5)
        assert (here.disparity_px[~finite] == 0).all()


def test_the_right_eye_sees_a_left_point_at_its_disparity_or_something_nearer() -> None:
    here, (u, v) = truth(0), pixels()
    right_label = camera()._hits(0, Eye.RIGHT).label
    right_px = sampled(here.right_disparity_px, u - here.disparity_px, v, right_label, here.label)
    error_px = right_px - here.disparity_px
    shown = np.isfinite(error_px)
    assert shown.mean() > 0.6
    # But for pixels between two parts of one object, which interpolation mixes.
    assert (error_px[shown] > -INTERPOLATED_PX).mean() > 0.985
    assert (np.abs(error_px[shown]) < INTERPOLATED_PX).mean() > 0.97


@pytest.mark.parametrize("step", [1, -1], ids=["into the future", "into the past"])
@pytest.mark.parametrize("moving", [False, True], ids=["still things", "moving things"])
def test_flow_leads_to_where_the_other_frame_shows_the_same_point(step: int, moving: bool) -> None:
    here, there, (u, v) = truth(1), truth(1 + step), pixels()
    motion = here.into_future if step == 1 else here.into_past
    u_then, v_then = u + motion.flow_px[..., 0], v + motion.flow_px[..., 1]
    seen_px = sampled(there.disparity_px, u_then, v_then, there.label, here.label)
    then_px = RECIPE.focal_px * RECIPE.baseline_m / motion.depth_m
    judged = np.isfinite(seen_px) & (is_moving(1) == moving)
    assert judged.sum() > (60 if moving else 2000)
    error_px = np.abs(seen_px - then_px)[judged]
    assert np.median(error_px) < INTERPOLATED_PX
    assert (error_px < 2 * INTERPOLATED_PX).mean() > 0.93


def test_flow_there_and_back_is_no_flow() -> None:
    here, there, (u, v) = truth(0), truth(1), pixels()
    flow = here.into_future.flow_px
    u_then, v_then = u + flow[..., 0], v + flow[..., 1]
    for axis in (0, 1):
        plane = np.ascontiguousarray(there.into_past.flow_px[..., axis])
        back = sampled(plane, u_then, v_then, there.label, here.label)
        residue_px = np.abs(back + flow[..., axis])
        residue_px = residue_px[np.isfinite(residue_px)]
        assert residue_px.size > 2000
        assert np.median(residue_px) < 0.02


def test_still_points_move_as_the_geometry_of_the_warp_says() -> None:
    """Flow comes from points in the world; the warp from poses, disparities and Q alone."""
    recipe = RECIPE
    rig = RectifiedRig(
        recipe.width, recipe.height, recipe.focal_px, recipe.focal_px, (recipe.width - 1) / 2,
        (recipe.width - 1) / 2, (recipe.height - 1) / 2, recipe.baseline_m,
    )  # fmt: skip
    path = camera().path
    prev, curr = (
        Pose.from_matrix(path.world_from_left(path.frame_time_s(frame))) for frame in (0, 1)
    )
    transform = uvd_curr_from_prev(rig, curr.inverse() @ prev).astype(np.float64)
    here, (u, v) = truth(0), pixels()
    uvd = np.stack([u, v, here.disparity_px, np.ones_like(u)], -1) @ transform.T
    warped = uvd[..., :3] / uvd[..., 3:]
    still = ~is_moving(0)
    expected_u = u + here.into_future.flow_px[..., 0]
    expected_v = v + here.into_future.flow_px[..., 1]
    expected_d = recipe.focal_px * recipe.baseline_m / here.into_future.depth_m
    for got, expected in ((0, expected_u), (1, expected_v), (2, expected_d)):
        np.testing.assert_allclose(warped[still, got], expected[still], atol=10 * EXACT_PX)
    # And what moves by itself does not.
    away_px = np.abs(warped[..., 0] - expected_u)[is_moving(0)]
    assert np.median(away_px) > 0.1


def test_rays_are_unit_vectors_through_the_points_that_pixels_show() -> None:
    rays = truths.rays(camera().optics)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1, atol=1e-6)
    u, v = pixels()
    focal_px = RECIPE.focal_px
    np.testing.assert_allclose(rays[..., 0] / rays[..., 2], (u - 47.5) / focal_px, atol=1e-6)
    np.testing.assert_allclose(rays[..., 1] / rays[..., 2], (v - 35.5) / focal_px, atol=1e-6)
    world_from_left = camera().world_from_eye(0.0, Eye.LEFT)
    hits, depth_m = camera()._hits(0, Eye.LEFT), truth(0).depth_m
    seen = (hits.points_m - world_from_left[:3, 3]) @ world_from_left[:3, :3]
    finite = hits.label > 0
    along = rays * (depth_m / rays[..., 2])[..., None]
    np.testing.assert_allclose(along[finite], seen[finite], atol=1e-4)


def test_normals_are_unit_vectors_towards_the_camera() -> None:
    here, rays = truth(0), truths.rays(camera().optics)
    surface = here.label > 0
    np.testing.assert_allclose(np.linalg.norm(here.normals[surface], axis=-1), 1, atol=1e-5)
    facing = np.einsum("hwk,hwk->hw", here.normals, rays)[surface]
    assert (facing < 1e-3).all()


@pytest.mark.parametrize("name", ["floor", "ceiling", "rug", "wall"])
def test_normals_of_planes_are_those_of_their_depth(name: str) -> None:
    here = truth(0)
    rays = truths.rays(camera().optics).astype(np.float64)
    points = rays * (here.depth_m / rays[..., 2])[..., None]
    across, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    normal = np.cross(down, across)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    mine = (here.label == label_of(name)).astype(np.uint8)
    inner = cv2.erode(mine, np.ones((3, 3), np.uint8))[1:-1, 1:-1].astype(bool)
    # Frames and edges of the same thing have other normals; most of its pixels are its plane.
    expected = here.normals[1:-1, 1:-1]
    close = np.einsum("hwk,hwk->hw", normal, expected)[inner] > 1 - 1e-3
    assert close.size > 5
    assert close.mean() > 0.85


def test_every_pixel_of_an_object_lies_in_its_box_wherever_it_has_moved() -> None:
    for frame in FRAMES:
        hits = camera()._hits(frame, Eye.LEFT)
        for box in truth(frame).boxes:
            place = np.array(box["world_from_object"])
            points = hits.points_m[hits.label == box["label"]] - place[:3, 3]
            own = points @ place[:3, :3]
            assert (own > np.array(box["low_m"]) - 1e-4).all(), box["name"]
            assert (own < np.array(box["high_m"]) + 1e-4).all(), box["name"]


def test_boxes_are_tight_around_labels_and_complete() -> None:
    for frame in FRAMES:
        here = truth(frame)
        assert {box["label"] for box in here.boxes} == set(np.unique(here.label)) - {0}
        for box in here.boxes:
            inside = here.label[box["top"] : box["bottom"] + 1, box["left"] : box["right"] + 1]
            mine = inside == box["label"]
            assert mine.sum() == (here.label == box["label"]).sum() == box["pixels"]
            sides = mine[0], mine[-1], mine[:, 0], mine[:, -1]
            assert all(side.any() for side in sides)
        assert json.loads(json.dumps(here.boxes)) == here.boxes


def test_labels_name_the_same_object_in_every_frame() -> None:
    names: dict[int, str] = {}
    for frame in FRAMES:
        for box in truth(frame).boxes:
            assert names.setdefault(box["label"], box["name"]) == box["name"]
    assert set(MOVING) <= set(names.values())
    assert {"floor", "wall", "sofa"} <= set(names.values())


def test_a_second_scene_in_the_process_leaves_labels_as_they_were() -> None:
    before = truth(0).label
    other = StereoCamera(Recipe("studio", width=32, height=24), variant="scalar_rgb")
    assert {box["name"] for box in other.truth(0).boxes} >= {"floor", "wall"}
    np.testing.assert_array_equal(camera().truth(0).label, before)
