"""The stereo camera on its path: the clean pass, the final pass and the truth of any frame."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from vergence_models.data.xrbench import effects, rooms, truths
from vergence_models.data.xrbench.denoise import denoised
from vergence_models.data.xrbench.head_path import HeadPath, right_of
from vergence_models.data.xrbench.meshes import Matrix
from vergence_models.data.xrbench.recipe import Recipe
from vergence_models.data.xrbench.tracer import (
    CameraView,
    FirstHits,
    Optics,
    Planes,
    TracedLight,
    Tracer,
)

Image = NDArray[np.uint8]  # [H, W, 3], RGB


class Eye(IntEnum):
    LEFT = 0
    RIGHT = 1


@dataclass(frozen=True, slots=True, eq=False)
class FrameTruth:
    """Truth of the left view, unless named otherwise; see `truths` for shapes and frames."""

    disparity_px: truths.Plane
    right_disparity_px: truths.Plane
    depth_m: truths.Plane
    into_future: truths.Motion
    into_past: truths.Motion
    normals: truths.Plane
    label: NDArray[np.uint16]
    specular: NDArray[np.bool_]
    boxes: list[truths.Box]


class StereoCamera:
    """Films one recipe.

    Raises NoRenderer: as `Tracer`.
    """

    def __init__(self, recipe: Recipe, *, variant: str | None = None) -> None:
        self.recipe = recipe
        self.room = rooms.build(recipe.room, recipe.seed)
        self.path = HeadPath(recipe, self.room)
        self.optics = Optics(recipe.width, recipe.height, recipe.focal_px)
        self._tracer = Tracer(self.room, bounces=recipe.bounces, variant=variant)
        self._gain: float | None = None

    def world_from_eye(self, time_s: float, eye: Eye) -> Matrix:
        """Pose [4, 4], OpenCV camera axes."""
        left = self.path.world_from_left(time_s)
        return right_of(left, self.recipe.baseline_m) if eye is Eye.RIGHT else left

    def clean(self, frame: int, eye: Eye) -> Image:
        """The image of a pinhole camera at one instant: geometry and light alone."""
        time_s = self.path.frame_time_s(frame)
        light = self._tracer.light(
            self.optics, self.world_from_eye(time_s, eye), time_s,
            samples=self.recipe.samples, seed=2 * frame + eye,
        )  # fmt: skip
        return self._developed(light, frame, eye)

    def final(self, frame: int, eye: Eye) -> Image:
        """The same moment seen through a lens, with an exposure time and a rolling shutter."""
        recipe = self.recipe
        time_s = self.path.frame_time_s(frame)
        instants = effects.schedule(recipe.effects, recipe.height, self._moved_px(time_s))
        # Paths are shared among the instants in which a row is open.
        open_in = sum(int(instant.open.sum()) for instant in instants) / recipe.height
        samples = max(1, round(recipe.samples / open_in))
        total = np.zeros((recipe.height, recipe.width, 10), np.float32)
        times = np.zeros((recipe.height, 1, 1), np.float32)
        for index, instant in enumerate(instants):
            then_s = time_s + instant.time_s
            rows = len(instant.open)
            light = self._tracer.light(
                self.optics, self.world_from_eye(then_s, eye), then_s, samples=samples,
                seed=(2 * frame + eye) * len(instants) + index + 1_000_000,
                flicker=effects.lamp_gain(recipe.effects, then_s),
                view=CameraView(instant.first_row, rows, instant.lens_m, recipe.effects.focus_m),
            )  # fmt: skip
            band = np.s_[instant.first_row : instant.first_row + rows]
            opened = instant.open[:, None, None]
            planes = (light.radiance, light.albedo, light.normals, light.depth_m)
            total[band] += opened * np.concatenate(planes, -1)
            times[band] += opened
        total /= times
        light = TracedLight(total[..., :3], total[..., 3:6], total[..., 6:9], total[..., 9:])
        return self._developed(light, frame, eye, glare=recipe.effects.glare)

    def truth(self, frame: int) -> FrameTruth:
        recipe, optics = self.recipe, self.optics
        now_s = self.path.frame_time_s(frame)
        left, right = (self.world_from_eye(now_s, eye) for eye in Eye)
        hits = self._hits(frame, Eye.LEFT)
        depth, right_depth = (
            truths.depth_m(hits, left),
            truths.depth_m(self._hits(frame, Eye.RIGHT), right),
        )

        def motion(other: int) -> truths.Motion:
            then_s = self.path.frame_time_s(other)
            then = then_s, self.path.world_from_left(then_s)
            return truths.motion(hits, self.room, optics, (now_s, left), then)

        return FrameTruth(
            disparity_px=truths.disparity_px(depth, optics.focal_px, recipe.baseline_m),
            right_disparity_px=truths.disparity_px(right_depth, optics.focal_px, recipe.baseline_m),
            depth_m=depth,
            into_future=motion(frame + 1),
            into_past=motion(frame - 1),
            normals=truths.normals(hits, left),
            label=hits.label,
            specular=hits.specular,
            boxes=truths.boxes(hits, self.room, now_s),
        )

    def _hits(self, frame: int, eye: Eye) -> FirstHits:
        time_s = self.path.frame_time_s(frame)
        return self._tracer.hits(self.optics, self.world_from_eye(time_s, eye), time_s)

    def _developed(self, light: TracedLight, frame: int, eye: Eye, *, glare: float = 0.0) -> Image:
        radiance: Planes = light.radiance
        if self.recipe.denoise:
            # One more pixel around mirrors and glass: outlines are a mixture.
            shiny = self._hits(frame, eye).specular.astype(np.uint8)
            keep = cv2.dilate(shiny, np.ones((3, 3), np.uint8)).astype(bool)
            radiance = denoised(light, keep)
        return effects.as_srgb(effects.with_glare(radiance, glare), self._exposure())

    def _exposure(self) -> float:
        """One gain for the sequence, by a small picture of its first frame."""
        if self._gain is None:
            recipe = self.recipe
            small = Optics(64, 48, 64 * recipe.focal_px / recipe.width)
            light = self._tracer.light(
                small, self.world_from_eye(0.0, Eye.LEFT), 0.0, samples=32, seed=0
            )
            self._gain = effects.auto_exposure(light.radiance)
        return self._gain

    def _moved_px(self, time_s: float) -> float:
        """The motion in the image of a point at one metre while a row is open, in px."""
        half_s = self.recipe.effects.exposure_s / 2
        start, end = (self.path.world_from_left(time_s + dt) for dt in (-half_s, half_s))
        turned = np.linalg.norm(start[:3, :3].T @ end[:3, :3] - np.eye(3)) / np.sqrt(2)
        moved_m = np.linalg.norm(end[:3, 3] - start[:3, 3])
        return float((turned + moved_m) * self.recipe.focal_px)
