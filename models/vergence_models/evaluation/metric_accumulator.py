"""The figures of one method over footage, added up frame by frame."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from vergence_models.evaluation.metrics import calibration, error_measures, temporal_error
from vergence_models.evaluation.stepping import Footage, FootageView, Prediction

FRAME_PIXELS = 640 * 480  # times are reported for a frame of this size
SETTLED = 1.1  # a start has settled once it is within 10 % of the later mean


@dataclass(slots=True)
class MetricAccumulator:
    """The figures of one method on one kind of footage."""

    frames: list[dict[str, float]] = field(default_factory=list)
    calibrations: list[dict[str, float]] = field(default_factory=list)
    flicker: list[float] = field(default_factory=list)
    by_index: dict[int, list[float]] = field(default_factory=dict)  # frame -> EPEs
    cpu_s: float = 0.0
    wall_s: float = 0.0
    size: float = 0.0  # all pixels so far, in frames of FRAME_PIXELS

    def add(self, footage: Footage, predictions: Iterator[Prediction]) -> None:
        before: tuple[FootageView, Prediction] | None = None
        for index, view in enumerate(footage.views):
            cpu, wall = time.process_time(), time.perf_counter()
            prediction = next(predictions)
            self.cpu_s += time.process_time() - cpu
            self.wall_s += time.perf_counter() - wall
            self.size += footage.rig.width * footage.rig.height / FRAME_PIXELS
            self._judge(index, view, prediction)
            self._follow(footage, before, (view, prediction))
            before = view, prediction

    def _judge(self, index: int, view: FootageView, prediction: Prediction) -> None:
        if view.truth_px is None:
            return
        measures = error_measures(prediction.disparity_px, view.truth_px)
        if measures is None:
            return
        self.frames.append(measures)
        self.by_index.setdefault(index, []).append(measures["epe"])
        if prediction.sigma_px is not None:
            calibrated = calibration(prediction.disparity_px, prediction.sigma_px, view.truth_px)
            self.calibrations += [calibrated] if calibrated else []

    def _follow(
        self,
        footage: Footage,
        before: tuple[FootageView, Prediction] | None,
        now: tuple[FootageView, Prediction],
    ) -> None:
        if before is None:
            return
        (old, old_prediction), (new, new_prediction) = before, now
        if old.truth_px is None or new.truth_px is None:
            return
        if old.world_from_left is None or new.world_from_left is None:
            return
        flicker = temporal_error(
            footage.rig,
            new.world_from_left.inverse() @ old.world_from_left,
            (old_prediction.disparity_px, new_prediction.disparity_px),
            (old.truth_px, new.truth_px),
        )
        if flicker is not None:
            self.flicker.append(flicker)

    def summary(self) -> dict[str, float]:
        """Means over frames; TEPE where poses and dense truth allow it; times per frame."""
        found = means(self.frames)
        if self.flicker:
            found["tepe"] = float(np.mean(self.flicker))
        found.update(means(self.calibrations))
        found["cpu_ms"] = 1e3 * self.cpu_s / max(self.size, 1e-9)
        found["wall_ms"] = 1e3 * self.wall_s / max(self.size, 1e-9)
        return {name: round(value, 4) for name, value in found.items()}

    def epe_by_frame(self) -> list[float]:
        """Mean EPE of each frame of the sequences, in their order."""
        return [round(float(np.mean(self.by_index[index])), 4) for index in sorted(self.by_index)]


def means(rows: list[dict[str, float]]) -> dict[str, float]:
    return {name: float(np.mean([row[name] for row in rows])) for name in (rows[0] if rows else {})}


def settled_frame(epe_by_frame: Sequence[float]) -> int | None:
    """The first frame, counted from 1, from which the start of a sequence has settled.

    That is: within 10 % of the mean over the later half. None of fewer than four frames.
    """
    if len(epe_by_frame) < 4:
        return None
    later = float(np.mean(epe_by_frame[len(epe_by_frame) // 2 :]))
    return next(
        (k + 1 for k, epe in enumerate(epe_by_frame) if epe <= SETTLED * later), len(epe_by_frame)
    )
