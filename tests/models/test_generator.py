"""Laws of the synthetic stereo video: geometry, appearance, time, determinism, storage."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from vergence_models.data import pool
from vergence_models.data.clips import StereoClips
from vergence_models.data.generator import ClipGenerator, GeneratorConfig
from vergence_models.data.materials import Material
from vergence_models.data.pool import ClipPool, write_shard
from vergence_models.data.render import render
from vergence_models.data.scenes import Builder, Light, Scene, turn_y
from vergence_models.data.sensor import SensorConfig, film_as_sensor
from vergence_models.data.shapes import Cutout, Shape, intersect
from vergence_models.data.textures import TextureBank
from vergence_models.data.truth import surface_truth
from vergence_models.data.views import Shot

SMALL = GeneratorConfig(width=128, height=96, frames=3, texture_size=64)
FOCAL_PX, BASELINE_M = 100.0, 0.12


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def generator() -> ClipGenerator:
    return ClipGenerator(SMALL)


@pytest.fixture(scope="module")
def clips(generator: ClipGenerator) -> StereoClips:
    """Rooms, streets and swarms as they come."""
    return generator.clips(seed=5, indices=range(8))


def still_life(build: Builder, *, poses: np.ndarray | None = None) -> Shot:
    """Film what was built from the world's origin, by one lamp behind the camera."""
    lamp = Light(np.array([0.3, -0.5, -1.0]), np.ones(3), 4.0)
    scene = Scene(
        primitives=np.array(build.rows, np.float32),
        lights=(lamp, lamp),
        shadow_target_m=np.array([0.0, 0.0, 2.0]),
        shadow_half_angle_rad=0.9,
        ambient=np.full(3, 0.5),
        sky_texture=0,
        sky_color=np.ones(3),
        exposure=0.4,
    )
    world_from_left = np.eye(4)[None] if poses is None else poses
    times_s = np.arange(len(world_from_left)) / 30
    return Shot(scene, world_from_left, times_s, FOCAL_PX, 63.5, 47.5, BASELINE_M)


def pixel_rays(width: int = 128, height: int = 96) -> tuple[np.ndarray, np.ndarray]:
    v, u = np.mgrid[:height, :width]
    return (u - 63.5) / FOCAL_PX, (v - 47.5) / FOCAL_PX


def film(shot: Shot, bank: TextureBank) -> np.ndarray:
    return render([shot], bank, width=128, height=96).disparity_px[0, 0].numpy()


PAINT = Material(texture=0, span_m=1.0)
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


def sampled_at(image: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Bilinear lookups in images [N, C, H, W] at pixel positions [N, H, W]."""
    height, width = image.shape[-2:]
    grid = torch.stack([u / (width - 1), v / (height - 1)], -1) * 2 - 1
    return torch.nn.functional.grid_sample(image, grid, align_corners=True)


def test_the_right_image_moved_by_the_disparity_is_the_left_image(clips: StereoClips) -> None:
    left, right = (eye.flatten(0, 1).float() for eye in (clips.left, clips.right))
    disparity, visible = clips.disparity_px.flatten(0, 1), clips.visible.flatten(0, 1)
    v, u = torch.meshgrid(torch.arange(96.0), torch.arange(128.0), indexing="ij")

    def difference(wrong_px: float) -> float:
        moved = sampled_at(right, u - disparity - wrong_px, v.expand_as(disparity))
        return float((moved - left).abs().mean(1)[visible].mean())

    # Gloss, mirrors and the edges between pixels stay; everything else must agree.
    assert difference(0) < 0.6 * min(difference(-1), difference(1))
    assert difference(0) < 0.35 * min(difference(-4), difference(4))


def reprojected(clips: StereoClips, index: int, frame: int) -> tuple[Tensor, Tensor, Tensor]:
    """Where the pixels of a frame lie in the next one: u, v and disparity there, each [H, W]."""
    fx, fy, cx, cy, baseline_m = (
        float(getattr(clips, name)[index]) for name in ("fx", "fy", "cx", "cy", "baseline_m")
    )
    height, width = clips.disparity_px.shape[-2:]
    v, u = torch.meshgrid(
        torch.arange(height, dtype=torch.float64),
        torch.arange(width, dtype=torch.float64),
        indexing="ij",
    )
    z = fx * baseline_m / clips.disparity_px[index, frame].double()
    point = torch.stack([(u - cx) / fx * z, (v - cy) / fy * z, z, torch.ones_like(z)])
    world_from_left = clips.world_from_left[index]
    next_from_this = world_from_left[frame + 1].inverse() @ world_from_left[frame]
    x, y, z, _ = (next_from_this @ point.flatten(1)).view(4, height, width)
    disparity = torch.where(z > 0.05, fx * baseline_m / z, torch.nan)
    return fx * x / z + cx, fy * y / z + cy, disparity


def agreement(clips: StereoClips, index: int) -> float:
    """The share of a clip's still surfaces whose disparity the next frame confirms."""
    right = total = 0
    for frame in range(clips.frames - 1):
        u, v, expected = reprojected(clips, index, frame)
        height, width = u.shape
        inside = (u > 1) & (u < width - 2) & (v > 1) & (v < height - 2) & expected.isfinite()
        column, row = u[inside].round().long(), v[inside].round().long()
        found = clips.disparity_px[index, frame + 1]
        # Within the 3x3 pixels around the place: pixel centres of two views never coincide.
        around = torch.stack(
            [found[row + i, column + j] for i in (-1, 0, 1) for j in (-1, 0, 1)]
        ).double()
        wanted = expected[inside]
        slack_px = 0.02 + 0.005 * wanted
        fits = (around.amin(0) <= wanted + slack_px) & (around.amax(0) >= wanted - slack_px)
        right, total = right + int(fits.sum()), total + len(fits)
    return right / max(total, 1)


def furnished_shot() -> Shot:
    """A still scene with a box, a ball and a post, and a camera that moves and turns."""
    b = Builder()
    b.wall((0, 0, 4), 20, 20, PAINT)
    b.floor((0, 1.2, 0), 20, 20, PAINT)
    b.box((-0.6, 0.6, 2.2), (0.3, 0.6, 0.3), PAINT)
    b.ball((0.5, 0.2, 2.6), (0.4, 0.3, 0.4), PAINT)
    b.post((0.1, 0, 1.8), 0.1, 1.0, PAINT, taper=0.3)
    step = np.eye(4)
    step[:3, :3], step[:3, 3] = turn_y(0.03), (0.03, -0.02, 0.05)
    poses = np.stack([np.linalg.matrix_power(step, k) for k in range(4)])
    return still_life(b, poses=poses)


def furnished_room(bank: TextureBank) -> StereoClips:
    return render([furnished_shot()], bank, width=128, height=96)


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


def test_a_clip_is_the_same_alone_and_in_company(
    generator: ClipGenerator, clips: StereoClips
) -> None:
    alone = ClipGenerator(SMALL).clips(seed=5, indices=[3])
    for name in StereoClips.__slots__:
        assert torch.equal(getattr(alone, name), getattr(clips[3:4], name)), name
    other = generator.clips(seed=6, indices=[3])
    assert not torch.equal(other.left, alone.left)


def test_disparities_are_positive_and_visible_points_have_a_match(clips: StereoClips) -> None:
    assert (clips.disparity_px >= 0).all()
    assert (clips.disparity_px > 0).float().mean() > 0.9
    u = torch.arange(128.0) - clips.disparity_px
    assert (u[clips.visible] >= 0).all()
    assert 0.5 < clips.visible.float().mean() < 0.99


def test_what_stands_behind_a_near_thing_is_hidden_beside_it(generator: ClipGenerator) -> None:
    b = Builder()
    b.wall((0, 0, 4.0), 50, 50, PAINT)  # 3 px
    b.wall((0, 0, 1.0), 0.2, 5, PAINT)  # 12 px, columns 43.5 to 83.5 of the left image
    visible = render([still_life(b)], generator.bank, width=128, height=96).visible[0, 0, 48]
    hidden = (~visible).nonzero()[:, 0].tolist()
    # The strip hides 9 columns at its left; 3 more see past the right image's border.
    assert hidden == [0, 1, 2, *range(35, 44)]


def test_the_sensor_leaves_the_truth_alone_and_follows_its_seed(clips: StereoClips) -> None:
    recorded = film_as_sensor(clips, np.random.default_rng(1))
    again = film_as_sensor(clips, np.random.default_rng(1))
    for name in StereoClips.__slots__:
        untouched = name not in {"left", "right"}
        assert torch.equal(getattr(recorded, name), getattr(clips, name)) == untouched, name
        assert torch.equal(getattr(recorded, name), getattr(again, name)), name


def test_a_perfect_sensor_changes_nothing(clips: StereoClips) -> None:
    perfect = SensorConfig(
        noise=0, tone=0, mismatch=0, flicker=0, vignetting=0, defocus=0, motion_blur=0,
        misalignment=0, jpeg=0, grey=0,
    )  # fmt: skip
    recorded = film_as_sensor(clips, np.random.default_rng(1), perfect)
    assert torch.equal(recorded.left, clips.left)
    assert torch.equal(recorded.right, clips.right)


def test_a_pool_gives_back_what_was_written(tmp_path: Path, clips: StereoClips) -> None:
    write_shard(tmp_path / "shard_0_000000", clips[:3])
    write_shard(tmp_path / "shard_0_000003", clips[3:])
    stored = ClipPool(tmp_path)
    assert len(stored) == 8
    back = stored.clips(range(8))
    for name in StereoClips.__slots__:
        if name != "disparity_px":
            assert torch.equal(getattr(back, name), getattr(clips, name)), name
    step_px = 1 / pool.DISPARITY_SCALE
    assert (back.disparity_px - clips.disparity_px).abs().max() <= step_px / 2


def test_a_pool_sees_only_whole_shards_of_its_size(tmp_path: Path, clips: StereoClips) -> None:
    write_shard(tmp_path / "shard_0_000000", clips[:2])
    (tmp_path / "shard_0_000002.partial").mkdir()
    stored = ClipPool(tmp_path, size=(128, 96))
    assert len(stored) == 2
    write_shard(tmp_path / "shard_0_000002", clips[2:4])
    stored.refresh()
    assert len(stored) == 4
    with pytest.raises(FileNotFoundError, match="64x64"):
        ClipPool(tmp_path, size=(64, 64))


def test_windows_flips_and_reversal_keep_the_geometry(
    tmp_path: Path, generator: ClipGenerator
) -> None:
    write_shard(tmp_path / "shard_0_000000", furnished_room(generator.bank))
    rng = np.random.default_rng(0)
    stored = ClipPool(tmp_path)
    for chances in ({"reverse": 1.0}, {"flip": 1.0}, {"skip": 1.0}):
        batch = stored.sample(rng, 1, frames=2, crop=(96, 80), **chances)
        assert batch.left.shape == (1, 2, 3, 80, 96)
        assert agreement(batch, 0) > 0.93, chances


def test_a_stopped_pool_goes_on_where_it_was(tmp_path: Path) -> None:
    config = GeneratorConfig(width=48, height=32, frames=2, texture_size=32)

    def rendered(clips: int) -> int:
        return pool.render_pool(tmp_path, config, clips=clips, seed=1, shard_clips=2, workers=1)

    assert rendered(2) == 2
    assert rendered(4) == 2
    assert rendered(4) == 0
    assert len(ClipPool(tmp_path)) == 4


def test_a_folder_without_photographs_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=tmp_path.name):
        TextureBank.create(seed=0, photos=tmp_path)
