"""The latest results of a session, for readers in any thread."""

import time
from collections.abc import Callable

from vergence.reprojection import DepthView, Fill, View, reproject
from vergence.results import DepthResult
from vergence_proto.geometry import Pose

# A keyframe shows what has left the picture: it must be old enough to have looked elsewhere, and
# young enough that the scene is still the same.
_KEYFRAME_AGES_NS = (300_000_000, 1_000_000_000)


class RecentResults:
    """The newest result, and older ones to fill its gaps.

    One thread adds; any thread reads without waiting, because each change replaces one reference.
    """

    def __init__(self, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._now_ns = now_ns  # the clock of captures
        self.kept: tuple[DepthResult, ...] = ()  # the newest first

    @property
    def latest(self) -> DepthResult | None:
        """The newest result; None before the first."""
        return next(iter(self.kept), None)

    def add(self, result: DepthResult) -> None:
        """Keep a result, and forget those that are too old for a keyframe."""
        if self.kept and result.capture_ns < self.kept[0].capture_ns:
            return  # a lossless answer that came late
        oldest, spacing = _KEYFRAME_AGES_NS[1], _KEYFRAME_AGES_NS[0]
        keep = [result]
        for each in self.kept:
            # Beside the newest, one result in each interval: a handful of maps, whatever the rate.
            far = keep[-1].capture_ns // spacing != each.capture_ns // spacing
            if far and result.capture_ns - each.capture_ns <= oldest + spacing:
                keep.append(each)
        self.kept = tuple(keep)

    def depth_at(
        self,
        world_from_view: Pose,
        view: View | None,
        *,
        at_ns: int | None,
        fill: Fill,
        max_age_s: float,
    ) -> DepthView | None:
        """Show the newest result from another pose; None if there is none of at most that age."""
        kept = self.kept  # one read: another thread may replace it
        at_ns = self._now_ns() if at_ns is None else at_ns
        if not kept or at_ns - kept[0].capture_ns > max_age_s * 1e9:
            return None
        latest, *older = kept
        youngest, oldest = _KEYFRAME_AGES_NS
        keyframes = [
            each
            for each in older
            if each.world_from_left is not None
            and youngest <= latest.capture_ns - each.capture_ns <= oldest
        ]
        return reproject(
            latest, world_from_view, view, at_ns=at_ns, keyframes=keyframes[:1], fill=fill
        )
