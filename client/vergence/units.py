"""Lengths that can hardly be metres."""

import logging

import numpy as np

from vergence_proto.geometry import RectifiedRig
from vergence_proto.types import StereoRig

log: logging.Logger = logging.getLogger("vergence")

# Longer ones exist, between aeroplanes and satellites; a hundred millimetres read as metres are
# the usual mistake.
_LONG_BASELINE_M = 10.0


def warn_of_baseline(rig: StereoRig | RectifiedRig) -> None:
    """Log a warning if the baseline looks like millimetres."""
    if isinstance(rig, RectifiedRig):
        baseline_m = rig.baseline_m
    else:
        baseline_m = float(np.linalg.norm(rig.left_from_right.translation_m))
    if baseline_m > _LONG_BASELINE_M:
        log.warning(
            "the baseline is %g m: are its lengths millimetres? Depths are right only if it is "
            "stated in metres",
            baseline_m,
        )
