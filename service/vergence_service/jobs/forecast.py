"""What an upload will cost and lack, as far as that shows before its frames are stepped."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vergence_proto.datasets import StereoSource
from vergence_proto.datasets.source import FrameFiles
from vergence_proto.jobs import Quality, WarningKind
from vergence_service.jobs.job import JobWarning
from vergence_service.jobs.sources import relative_text
from vergence_service.streams.continuity import ContinuityLimits

# A cold start has more iterations and looks closer: python tests/benchmarks/batch_throughput.py
COLD_WORK = 8.0
_NAMED_AT_MOST = 20
# A pass backward steps some frames twice, see ``passes``.
_EXTRA_WORK = {Quality.FAST: 0.0, Quality.STEADY: 1.2, Quality.BEST: 1.2 + COLD_WORK}


@dataclass(frozen=True, slots=True)
class Forecast:
    """What is known of a job when it is accepted."""

    cold_frames: int
    warnings: tuple[JobWarning, ...]


def forecast(
    sequence: StereoSource,
    folder: Path,
    limits: ContinuityLimits,
    unreadable: Sequence[str],
    *,
    recurrent: bool,
) -> Forecast:
    """Find the frames that will start cold, and what else a user should know now.

    ``unreadable`` are the reasons why images below ``folder`` cannot be read. Every frame is a cold
    start for a model that is not ``recurrent``: nobody needs a warning of that.
    """
    cold = _cold_frames(sequence.files, limits)
    warnings: list[JobWarning] = []
    if not recurrent:
        pass
    elif len(sequence) > 1 and all(each.world_from_left is None for each in sequence.files):
        warnings.append(
            JobWarning(
                WarningKind.NO_POSES,
                "no frame has a pose, so every frame is a cold start, about "
                f"{COLD_WORK:.0f} times slower, and maps flicker more; add the poses of the camera",
            )
        )
    elif cold > 1:
        warnings.append(
            JobWarning(
                WarningKind.COLD_FRAMES,
                f"{cold} of {len(sequence)} frames start cold, since their pose is missing or "
                f"jumps, or their time does; each takes about {COLD_WORK:.0f} times as long",
            )
        )
    if not sequence.metric:
        warnings.append(
            JobWarning(
                WarningKind.GUESSED_UNITS,
                "the calibration or its unit is not known: disparity is right, but depth is not in "
                "metres",
            )
        )
    if unreadable:
        named = "; ".join(unreadable[:_NAMED_AT_MOST])
        warnings.append(
            JobWarning(WarningKind.UNREADABLE, f"{len(unreadable)} images unreadable: {named}")
        )
    notes = (relative_text(note, folder) for note in sequence.notes)
    warnings += [JobWarning(WarningKind.DATA, note) for note in notes]
    return Forecast(cold, tuple(warnings))


def extra_work(quality: Quality) -> float:
    """Return the work of a frame beyond its one step, in warm steps."""
    return _EXTRA_WORK[quality]


def _cold_frames(files: Sequence[FrameFiles], limits: ContinuityLimits) -> int:
    """Count the frames that cannot continue from the one before, by the rules of streams."""
    cold = 1 if files else 0
    for before, after in itertools.pairwise(files):
        prev, curr = before.world_from_left, after.world_from_left
        gap_s = (after.capture_ns - before.capture_ns) / 1e9
        if prev is None or curr is None or not 0 <= gap_s <= limits.max_gap_s:
            cold += 1
            continue
        with np.errstate(over="ignore", invalid="ignore"):
            jump_m = float(np.linalg.norm(curr.translation_m - prev.translation_m))
            cosine = (float(np.sum(prev.rotation * curr.rotation)) - 1) / 2
        jump_deg = float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
        cold += not (jump_m <= limits.max_jump_m and jump_deg <= limits.max_jump_deg)
    return cold
