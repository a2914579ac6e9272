"""The clock of ``capture_ns``: what a time of it may be, and the age of a result by it."""

import logging
import math
import operator
import time
from collections.abc import Callable

from vergence_proto.errors import BadShape

log: logging.Logger = logging.getLogger("vergence")

_UNITS = ((31_557_600.0, "years"), (86_400.0, "days"), (3600.0, "hours"), (1.0, "s"))
_INT64 = range(-(2**63), 2**63)
# Another clock is off by years, or by the time since the machine was started: minutes at least.
_AGES_S = (-1.0, 120.0)
# A session's first frame is no older if its times are of the clock; on a machine that was started a
# minute ago, times that count from 0 are near the clock's too.
_FIRST_AGE_S = 2.0
# No stereo camera is faster: its times are microseconds, milliseconds or seconds.
_LEAST_STEP_NS = 100_000


class CaptureClock:
    """The clock of one session's frames, which checks their times.

    ``now_ns`` returns the time of that clock, and every frame must then be of it. Without one,
    times should be those of ``time.monotonic_ns()`` if the session is ``live``, and must go on to
    be once they were.
    """

    def __init__(self, now_ns: Callable[[], int] | None = None, *, live: bool = True) -> None:
        self.now_ns: Callable[[], int] = now_ns or time.monotonic_ns
        self._latest_ns: int | None = None
        self._warn_of_steps = True
        self._live = live
        self._first = True  # no time was checked yet
        self._keeps = now_ns is not None  # every time must be of the clock

    def checked_ns(self, capture_ns: object) -> int:
        """Return the time; now for None. Log once what is odd about the times.

        Raises BadShape: it is no whole number, does not fit 64 bits, or is impossible on the clock
        that was stated, or that the earlier times were of.
        """
        if capture_ns is None:
            return _whole(self.now_ns())
        whole_ns = _whole(capture_ns)
        age_s = self.age_s(whole_ns)
        if self._keeps and math.isnan(age_s):
            raise BadShape(
                "expected a capture_ns of the last two minutes of the session's clock, got "
                f"{_distance(whole_ns - self.now_ns())}; state the clock of your camera as clock="
            )
        step_ns = whole_ns - self._latest_ns if self._latest_ns is not None else 0
        self._latest_ns = whole_ns
        first, self._first = self._first, False
        if self._live and first:
            self._keeps = self._keeps or age_s < _FIRST_AGE_S
        if self._live and first and math.isnan(age_s):
            log.warning("capture_ns is no time of time.monotonic_ns(): the ages of results are NaN")
        if self._warn_of_steps and 0 < step_ns < _LEAST_STEP_NS:
            self._warn_of_steps = False
            log.warning(
                "two frames were captured %d ns apart: is capture_ns in nanoseconds? In another "
                "unit, gaps between frames are not noticed",
                step_ns,
            )
        return whole_ns

    def age_s(self, capture_ns: int) -> float:
        """Return the seconds since ``capture_ns``; NaN if it cannot be a time of the clock."""
        age_s = (self.now_ns() - capture_ns) * 1e-9
        return age_s if _AGES_S[0] < age_s < _AGES_S[1] else math.nan


def _distance(ahead_ns: int) -> str:
    seconds = abs(ahead_ns) * 1e-9
    unit, name = next((each for each in _UNITS if seconds >= each[0]), _UNITS[-1])
    return f"a time {seconds / unit:.1f} {name} {'after' if ahead_ns > 0 else 'before'} its now"


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
