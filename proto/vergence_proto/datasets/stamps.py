"""Time stamps of recordings: read in the unit that they have, sorted, and paired up."""

import bisect
import re
from collections.abc import Mapping, Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from vergence_proto.datasets.files import DatasetError, read_lines

_NS_PER_S = 1_000_000_000
# Integers count one of these units. Cameras and trackers run at about 10 Hz, within a factor of
# thirty, so one unit alone makes the usual step between two stamps plausible.
_UNITS_NS = (1, 1_000, 1_000_000, _NS_PER_S)
_USUAL_STEP_NS = 1e8
_PAIRED_WITHIN_NS = 1_000_000


def read_stamped(path: Path, purpose: str) -> Mapping[int, str]:
    """Read lines of a stamp and something else, in order of time; return the rest by nanoseconds.

    A stamp with a decimal point is in seconds. Integers are nanoseconds, microseconds,
    milliseconds or seconds, whichever makes the steps between them most like those of a camera.
    Of equal stamps the first line counts. A first line of words is a heading.

    Raises DatasetError: there is no such file, or a line does not start with a stamp.
    """
    stamped: dict[Decimal, str] = {}
    for number, line in enumerate(read_lines(path, purpose)):
        stamp, _, rest = re.sub(r"[,;\s]+", " ", line, count=1).partition(" ")
        try:
            time = Decimal(stamp)
            if not (time.is_finite() and rest):
                raise InvalidOperation
        except InvalidOperation:
            if number == 0 and stamp[:1].isalpha():
                continue
            raise DatasetError(f"{path}: expected {purpose!r}, got {line[:80]!r}") from None
        stamped.setdefault(time, rest)
    unit_ns = _unit_ns(sorted(stamped))
    return {int(time * unit_ns): stamped[time] for time in sorted(stamped)}


def pairs_of(lefts: Sequence[int], rights: Sequence[int]) -> list[tuple[int, int]]:
    """Pair up ascending times in ns: each with the nearest, less than half a frame apart.

    Half a frame is half the usual step of ``lefts``, and at least a millisecond.
    """
    step_ns = float(np.median(np.diff(lefts))) if len(lefts) > 1 else 0.0
    apart_ns = max(step_ns / 2, _PAIRED_WITHIN_NS)
    paired = []
    for left in lefts:
        right = _nearest(rights, left)
        if right is not None and abs(right - left) < apart_ns and _nearest(lefts, right) == left:
            paired.append((left, right))
    return paired


def _unit_ns(times: Sequence[Decimal]) -> int:
    if any(time != int(time) for time in times):
        return _NS_PER_S
    if len(times) < 2:
        return 1
    step = float(np.median(np.diff(np.array(times, object)).astype(np.float64)))
    return min(_UNITS_NS, key=lambda unit_ns: abs(np.log(step * unit_ns / _USUAL_STEP_NS)))


def _nearest(times: Sequence[int], time: int) -> int | None:
    after = bisect.bisect_left(times, time)
    beside = times[max(after - 1, 0) : after + 1]
    return min(beside, key=lambda each: abs(each - time), default=None)
