"""Runs each method over each group of footage once, for all studies."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from rich.progress import Progress

from vergence_models.evaluation.methods import Method
from vergence_models.evaluation.metric_accumulator import MetricAccumulator
from vergence_models.evaluation.stepping import Footage, FootageView
from vergence_models.studies.footage import FootageGroup, StudySettings, clips_at, whole_clips
from vergence_models.studies.networks import StudiedNetwork
from vergence_proto.geometry import RectifiedRig


class Bench:
    """The networks, the clips, and the figures measured so far."""

    def __init__(
        self,
        networks: Sequence[StudiedNetwork],
        *,
        settings: StudySettings,
        cache: Path,
        workers: int,
        progress: Progress,
    ) -> None:
        self.networks = networks
        self.settings = settings
        self._cache = cache
        self._workers = workers
        self._progress = progress
        self._groups: dict[int | None, FootageGroup] = {}
        self._accumulators: dict[tuple[str, str], MetricAccumulator] = {}

    def clips(self) -> FootageGroup:
        """The held-out clips with calm head motion; renders them at the first call."""
        return self._group(None)

    def clips_at(self, speed: int) -> FootageGroup:
        """Shorter clips of the same scenes at a speed, measured on their last frame."""
        return self._group(speed)

    def _group(self, speed: int | None) -> FootageGroup:
        if speed not in self._groups:
            settings, cache, workers = self.settings, self._cache, self._workers
            self._progress.stop()  # rendering shows its own
            self._groups[speed] = (
                whole_clips(settings, cache, workers=workers)
                if speed is None
                else clips_at(speed, settings, cache, workers=workers)
            )
            self._progress.start()
        return self._groups[speed]

    def accumulators(
        self, group: FootageGroup, methods: Sequence[Method]
    ) -> dict[str, MetricAccumulator]:
        """Label -> figures over the group, for each method in the order given."""
        wanted = {method.label: method for method in methods}
        new = [m for label, m in wanted.items() if (group.name, label) not in self._accumulators]
        if new:
            task = self._progress.add_task(f"{len(new)} methods on {group.name}", total=None)
            found = {method.label: MetricAccumulator() for method in new}
            for footage in group:
                for method in new:
                    found[method.label].add(footage, method.predict(footage))
                    self._progress.update(
                        task, advance=1, description=f"{group.name}: {method.label}"
                    )
            self._progress.remove_task(task)
            self._accumulators |= {
                (group.name, label): accumulator for label, accumulator in found.items()
            }
        return {label: self._accumulators[group.name, label] for label in wanted}


def step_times_ms(
    methods: Sequence[Method], *, rounds: int, width: int = 640, height: int = 480
) -> dict[str, tuple[float, float]]:
    """Label -> median milliseconds of a frame that is not the first: wall, and CPU of all threads.

    The methods take turns, so that a busy moment of the machine hits all of them.
    """
    footage = textured_footage(width, height, rounds + 1)
    predictions = [(method.label, method.predict(footage)) for method in methods]
    times: dict[str, list[tuple[float, float]]] = {label: [] for label, _ in predictions}
    for turn in range(rounds + 1):
        for label, predicted in predictions:
            wall, cpu = time.perf_counter(), time.process_time()
            next(predicted)
            if turn:
                times[label].append((time.perf_counter() - wall, time.process_time() - cpu))
    medians = {label: 1e3 * np.median(spent, axis=0) for label, spent in times.items()}
    return {label: (float(wall), float(cpu)) for label, (wall, cpu) in medians.items()}


def textured_footage(width: int, height: int, frames: int) -> Footage:
    """A still view of noise at four scales, at a disparity of 16 px, for measuring times."""
    random = np.random.default_rng(0)
    wide = np.zeros((height, width + 16, 3), np.float32)
    for scale in (2, 8, 32, 128):
        small = random.uniform(-32, 32, (height // scale + 1, (width + 16) // scale + 1, 3))
        wide += cv2.resize(small.astype(np.float32), wide.shape[1::-1])
    image = (wide + 128).clip(0, 255).astype(np.uint8)
    left, right = (np.ascontiguousarray(image[:, x : x + width]) for x in (0, 16))
    rig = RectifiedRig(width, height, width, width, width / 2, width / 2, height / 2, 0.1)
    return Footage("textured", rig, [FootageView(left, right, None)] * frames)
