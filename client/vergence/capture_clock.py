"""The clock of ``capture_ns``: what a time of it may be, and the age of a result by it."""

import logging
import math
import operator
import time

from vergence_proto.errors import BadShape

log: logging.Logger = logging.getLogger("vergence")

_INT64 = range(-(2**63), 2**63)
# Another clock is off by years, or by the time since the machine was started: minutes at least.
_AGES_S = (-1.0, 120.0)
# No stereo camera is faster: its times are microseconds, milliseconds or seconds.
_LEAST_STEP_NS = 100_000


class CaptureClock:
    """Checks the capture times of one session; ``live``: they should be times of this machine."""

    def __init__(self, *, live: bool) -> None:
        self._latest_ns: int | None = None
        self._warn_of_steps = True
        self._warn_of_ages = live

    def checked_ns(self, capture_ns: object) -> int:
        """Return the time; now for None. Log once what is odd about the times.

        Raises BadShape: it is no whole number, or does not fit 64 bits.
        """
        if capture_ns is None:
            return time.monotonic_ns()
        whole_ns = _whole(capture_ns)
        step_ns = whole_ns - self._latest_ns if self._latest_ns is not None else 0
        self._latest_ns = whole_ns
        if self._warn_of_ages and math.isnan(age_of(whole_ns)):
            self._warn_of_ages = False
            log.warning("capture_ns is no time of time.monotonic_ns(): the ages of results are NaN")
        if self._warn_of_steps and 0 < step_ns < _LEAST_STEP_NS:
            self._warn_of_steps = False
            log.warning(
                "two frames were captured %d ns apart: is capture_ns in nanoseconds? In another "
                "unit, gaps between frames are not noticed",
                step_ns,
            )
        return whole_ns


def age_of(capture_ns: int) -> float:
    """Return the seconds since ``capture_ns``; NaN if it is no time of this machine's clock."""
    age_s = (time.monotonic_ns() - capture_ns) * 1e-9
    return age_s if _AGES_S[0] < age_s < _AGES_S[1] else math.nan


def _whole(capture_ns: object) -> int:
    try:
        whole_ns = operator.index(capture_ns)  # type: ignore[arg-type]  # a caller's mistake
    except TypeError:
        pass
    else:
        if whole_ns in _INT64:
            return whole_ns
    raise BadShape(
        "expected capture_ns as a whole number of nanoseconds, as time.monotonic_ns() returns, "
        f"got {capture_ns!r}"
    )
