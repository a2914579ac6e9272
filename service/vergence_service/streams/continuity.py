"""Decide whether a stream may continue from its previous state, or must start without one."""

from dataclasses import dataclass

import numpy as np

from vergence_proto.types import Origin
from vergence_service.inference.model import RecurrentState, StereoView


@dataclass(frozen=True, slots=True, kw_only=True)
class ContinuityLimits:
    """The largest differences between two stepped frames of one stream that keep the state."""

    max_gap_s: float
    max_jump_m: float
    max_jump_deg: float


def break_between(
    state: RecurrentState, view: StereoView, limits: ContinuityLimits
) -> Origin | None:
    """Return the reason why ``view`` cannot continue from ``state``, or None if it can."""
    if view.world_from_left is None or state.world_from_left is None:
        return Origin.RESET_POSE_LOST
    if view.capture_ns < state.capture_ns:
        return Origin.RESET_TIME_BACKWARDS
    if view.capture_ns - state.capture_ns > limits.max_gap_s * 1e9:
        return Origin.RESET_GAP
    with np.errstate(over="ignore", invalid="ignore"):  # two cameras may be 1e300 m apart
        curr_from_prev = view.world_from_left.inverse() @ state.world_from_left
        jump_m = float(np.linalg.norm(curr_from_prev.translation_m))
    positions_known = view.position_known and state.position_known
    cosine = (float(np.trace(curr_from_prev.rotation)) - 1) / 2
    jump_deg = float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    if (positions_known and not jump_m <= limits.max_jump_m) or jump_deg > limits.max_jump_deg:
        return Origin.RESET_POSE_JUMP
    return None
