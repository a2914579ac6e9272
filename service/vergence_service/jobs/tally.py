"""What the frames of a job add up to while it runs."""

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Self

from vergence_proto.accuracy import Accuracy
from vergence_proto.job_results.records import FrameRecord
from vergence_proto.types import Origin

_NAMED_AT_MOST = 20
_WARM = {Origin.WARM.value, Origin.RESUMED.value}


@dataclass(frozen=True, slots=True)
class FrameCounts:
    """The sums over the first frames of a job."""

    frames: int = 0
    failed: int = 0  # without a map
    cold: int = 0  # started without a state
    errors: tuple[str, ...] = ()  # why a frame has no map, or no truth; only the first ones
    measured: tuple[Accuracy, ...] = ()  # of the frames with ground truth

    def after(self, record: FrameRecord) -> Self:
        """Return the sums with one more frame."""
        errors = self.errors
        if (why := record.error or record.note) and len(errors) < _NAMED_AT_MOST:
            errors = (*errors, why)
        measured = self.measured
        if record.accuracy is not None:
            values: dict[str, Any] = {
                name: math.nan if value is None else value
                for name, value in record.accuracy.items()
            }
            measured = (*measured, Accuracy(**values))
        return dataclasses.replace(
            self,
            frames=self.frames + 1,
            failed=self.failed + (record.error is not None),
            cold=self.cold + (record.error is None and record.origin not in _WARM),
            errors=errors,
            measured=measured,
        )

    def to_values(self) -> dict[str, Any]:
        """Return the sums for JSON."""
        return dataclasses.asdict(self)

    @classmethod
    def from_values(cls, values: dict[str, Any]) -> Self:
        """Read what :meth:`to_values` wrote. Raises TypeError or KeyError."""
        measured = tuple(Accuracy(**each) for each in values["measured"])
        return cls(**{**values, "errors": tuple(values["errors"]), "measured": measured})


def tally_of(records: Iterable[FrameRecord]) -> FrameCounts:
    """Return what frames add up to."""
    tally = FrameCounts()
    for record in records:
        tally = tally.after(record)
    return tally
