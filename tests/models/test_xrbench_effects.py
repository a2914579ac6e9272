"""Laws of the final pass's camera, against the pictures of the clean pass."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from vergence_models.data.xrbench import effects, meshes
from vergence_models.data.xrbench.camera import Eye, StereoCamera
from vergence_models.data.xrbench.denoise import denoised
from vergence_models.data.xrbench.recipe import Effects, Recipe
from vergence_models.data.xrbench.things import Panel, Room, Surface, Thing, Workbench
from vergence_models.data.xrbench.tracer import CameraView, Optics, TracedLight, Tracer

pytestmark = pytest.mark.slow  # it renders with a path tracer

STILL = Effects(exposure_s=0, readout_s=0, aperture_m=0, glare=0, flicker=0)
OPTICS = Optics(64, 48, 60.0)


class TestSchedule:
    @pytest.mark.parametrize(
        ("exposure_s", "readout_s"),
        [(0.008, 0.012), (0.02, 0.005), (0.008, 0.0), (0.0, 0.01)],
        ids=["rolling", "long exposure", "global", "short exposure"],
    )
    def test_each_row_gathers_light_around_its_own_time(
        self, exposure_s: float, readout_s: float
    ) -> None:
        chosen = dataclasses.replace(STILL, exposure_s=exposure_s, readout_s=readout_s)
        instants = effects.schedule(chosen, 100, moved_px=20)
        assert len({len(instant.open) for instant in instants}) == 1  # one compiled camera
        times: list[list[float]] = [[] for _ in range(100)]
        for instant in instants:
            for row in instant.first_row + np.nonzero(instant.open)[0]:
                times[row].append(instant.time_s)
        counts = [len(each) for each in times]
        assert min(counts) >= 13  # 20 px in steps of 1.5
        assert max(counts) - min(counts) <= 1
        middle_s = (np.arange(100) / 99 - 0.5) * readout_s
        step_s = (max(exposure_s, readout_s / 16) + readout_s) / len(instants)
        np.testing.assert_allclose([np.mean(each) for each in times], middle_s, atol=step_s)
        spans = [np.ptp(each) for each in times]
        assert max(spans) <= max(exposure_s, readout_s / 16) + 1e-6

    def test_without_any_effect_all_rows_are_open_at_mid_exposure(self) -> None:
        for instant in effects.schedule(STILL, 48, moved_px=0):
            assert abs(instant.time_s) < 1e-8
            assert instant.open.all()
            assert len(instant.open) == 48
            assert instant.lens_m == (0, 0)

    def test_light_comes_through_the_whole_lens(self) -> None:
        wide = dataclasses.replace(STILL, aperture_m=0.01)
        points = np.array([each.lens_m for each in effects.schedule(wide, 48, moved_px=60)])
        assert (np.hypot(*points.T) < 0.005).all()
        np.testing.assert_allclose(points.mean(0), 0, atol=4e-4)
        # Of a uniform disc of radius r, the mean square distance from the middle is r^2 / 2.
        assert np.mean(points**2) * 2 == pytest.approx(0.005**2 / 2, rel=0.02)


class TestGlare:
    def test_light_is_spread_and_none_is_lost(self) -> None:
        dark = np.zeros((60, 80, 3), np.float32)
        dark[10:13, 4:9] = 5.0
        spread = effects.with_glare(dark, 0.2)
        assert spread.sum() == pytest.approx(dark.sum(), rel=1e-4)
        assert spread[11, 6].max() < 5.0
        assert spread[14, 12].min() > 0
        assert effects.with_glare(dark, 0.0) is dark


def test_the_lamps_brighten_and_dim_around_their_own_brightness() -> None:
    chosen = dataclasses.replace(STILL, flicker=0.3, flicker_hz=100)
    period = np.arange(0, 0.01, 0.0001)
    gains = [effects.lamp_gain(chosen, t) for t in period]
    assert np.mean(gains) == pytest.approx(1)
    assert np.ptp(gains) == pytest.approx(0.6, abs=0.01)
    assert effects.lamp_gain(STILL, 0.0025) == 1


def test_srgb_of_white_black_and_middle_grey() -> None:
    levels = np.array([[[0.0, 0.2158605, 7.0]]], np.float32)
    np.testing.assert_array_equal(effects.as_srgb(levels, 1.0), [[[0, 128, 255]]])


def board(*, sky: float = 0.0) -> Room:
    """A patterned board two metres ahead under one lamp, in a black world or under a sky."""
    bench = Workbench()
    print_ = Surface(pattern="patchwork", pattern_seed=7, span_m=3.0)
    bench.add(print_, meshes.sheet(3, 3), (0, 0, 2))
    lamp = Panel("lamp", np.diag([-1.0, 1, -1, 1]), (0.5, 0.5), (3.0, 3.0, 3.0))
    lamp.world_from_panel[2, 3] = -0.5  # behind the camera, shining forward
    return Room((Thing("board", bench.parts(), np.eye(4)),), (lamp,), 5, sky, np.eye(4))


def traced(room: Room, *, flicker: float = 1.0, view: CameraView | None = None) -> TracedLight:
    tracer = Tracer(room, bounces=2, variant="scalar_rgb")
    return tracer.light(OPTICS, np.eye(4), 0.0, samples=16, seed=1, flicker=flicker, view=view)


def test_flicker_scales_the_light_of_the_lamps_and_no_other() -> None:
    by_lamp = traced(board()).radiance
    assert by_lamp.mean() > 0.01
    np.testing.assert_allclose(traced(board(), flicker=1.5).radiance, 1.5 * by_lamp, rtol=1e-4)
    lit_by_both = traced(board(sky=1.0)).radiance
    more = traced(board(sky=1.0), flicker=1.5).radiance
    np.testing.assert_allclose(more - lit_by_both, 0.5 * by_lamp, atol=0.02)


def test_a_band_is_the_same_rows_of_the_whole_image() -> None:
    whole = traced(board()).albedo
    band = traced(board(), view=CameraView(first_row=30, rows=10)).albedo
    assert band.shape == (10, 64, 3)
    # Other samples in each pixel: the pattern's edges differ by a little.
    difference = {row: np.abs(band - whole[row : row + 10]).mean() for row in range(25, 36)}
    assert min(difference, key=lambda row: float(difference[row])) == 30
    assert difference[30] < 0.5 * difference[29]


@pytest.mark.parametrize("axis", [0, 1], ids=["down", "right"])
def test_the_focus_stays_where_it_is_through_every_point_of_the_lens(axis: int) -> None:
    """A point out of focus moves by focal length x lens point x difference of inverse depths."""
    point_m = (0.1, 0.0) if axis == 1 else (0.0, 0.1)
    pinhole = traced(board()).albedo

    def through(focus_m: float) -> NDArray[np.float32]:
        return traced(board(), view=CameraView(0, 48, point_m, focus_m)).albedo

    assert np.abs(through(2.0) - pinhole).mean() < 1e-4  # the board's own distance
    nearer = through(1.0)
    difference = {
        shift: np.abs(nearer - np.roll(pinhole, shift, axis))[6:-6, 6:-6].mean()
        for shift in range(-5, 6)
    }
    expected_px = 60.0 * 0.1 * (1 / 1.0 - 1 / 2.0)
    assert min(difference, key=lambda shift: float(difference[shift])) == expected_px
    assert difference[3] < 0.5 * difference[2]


def test_filtering_removes_noise_and_keeps_texture() -> None:
    rng = np.random.default_rng(0)
    albedo = rng.choice([0.1, 0.7], (60, 80, 1)).repeat(3, 2).astype(np.float32)
    noise = rng.gamma(4, 0.25, (60, 80, 1)).astype(np.float32)  # of mean one
    normals = np.zeros((60, 80, 3), np.float32)
    normals[..., 2] = -1
    depth = np.full((60, 80, 1), 2.0, np.float32)
    noisy = TracedLight(albedo * noise, albedo, normals, depth)
    mirror = np.zeros((60, 80), np.bool_)
    mirror[5:9, 5:9] = True
    clean = denoised(noisy, mirror)
    np.testing.assert_array_equal(clean[mirror], noisy.radiance[mirror])
    before = np.abs(noisy.radiance - albedo)[~mirror].mean()
    assert np.abs(clean - albedo)[~mirror].mean() < 0.35 * before


class TestFinalPass:
    def test_without_effects_it_is_the_clean_pass(self) -> None:
        recipe = Recipe("studio", speed=20, width=32, height=24, samples=60, effects=STILL)
        camera = StereoCamera(recipe, variant="scalar_rgb")
        clean, final = camera.clean(0, Eye.LEFT), camera.final(0, Eye.LEFT)
        other = camera.clean(2, Eye.LEFT)
        difference = np.abs(clean.astype(int) - final).mean()
        assert difference < 6  # grey levels: other paths, other noise
        assert difference < 0.5 * np.abs(clean.astype(int) - other).mean()

    def test_rows_show_the_moment_at_which_they_are_read(self) -> None:
        """Read for two frames' time: the top is a frame old, the bottom a frame ahead."""
        late = dataclasses.replace(STILL, readout_s=2 / 30, exposure_s=0.5 / 30)
        recipe = Recipe("studio", speed=10, width=32, height=32, samples=30, effects=late)
        camera = StereoCamera(recipe, variant="scalar_rgb")
        rolled = camera.final(4, Eye.LEFT).astype(int)
        moments = {k: np.abs(camera.clean(4 + k, Eye.LEFT) - rolled) for k in (-1, 0, 1)}

        def nearest(rows: slice) -> int:
            return min(moments, key=lambda k: float(moments[k][rows].mean()))

        assert [nearest(rows) for rows in (np.s_[:5], np.s_[13:19], np.s_[27:])] == [-1, 0, 1]
