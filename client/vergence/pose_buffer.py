"""Poses as a tracker gives them, at its own rate, interpolated to the times of the frames."""

import bisect
import threading

import numpy as np

from vergence_proto.errors import BadPose
from vergence_proto.geometry import Matrix, Pose
from vergence_proto.types import PoseSample

_KEPT = 4096  # two seconds of a tracker of 2 kHz
# Over a longer gap, a head or a drone may not move in a straight line.
_LONGEST_GAP_NS = 100_000_000
_NEARLY_EQUAL = 1 - 1e-9  # the cosine of an angle below which slerp divides by almost zero


class PoseBuffer:
    """The latest poses of one session. Any thread may add, and any thread may ask.

    ``tracked_from_left`` maps left-camera coordinates to those of the tracked body.
    ``offset_s`` is added to the time of a frame to get the time of its pose.
    """

    def __init__(self, tracked_from_left: Pose | None, offset_s: float) -> None:
        self._tracked_from_left = tracked_from_left
        self._offset_ns = round(offset_s * 1e9)
        self._turn = threading.Lock()
        self._times_ns: list[int] = []
        self._samples: list[PoseSample] = []

    @property
    def in_use(self) -> bool:
        """Return True once a pose was added."""
        return bool(self._times_ns)

    def add(self, t_ns: int, world_from_tracked: PoseSample) -> None:
        """Add a pose. Raises BadPose: it is not finite, or its time is not after the latest."""
        pose = world_from_tracked.world_from_left
        valid = world_from_tracked.orientation_valid
        if valid and not (
            np.isfinite(pose.rotation).all() and np.isfinite(pose.translation_m).all()
        ):
            raise BadPose(f"expected finite numbers in a pose that is valid, got {pose}")
        with self._turn:
            if self._times_ns and t_ns <= self._times_ns[-1]:
                raise BadPose(
                    f"expected poses in the order of time, and this one is "
                    f"{(self._times_ns[-1] - t_ns) * 1e-6:.1f} ms before the latest"
                )
            self._times_ns.append(t_ns)
            self._samples.append(world_from_tracked)
            if len(self._times_ns) > 2 * _KEPT:
                del self._times_ns[:_KEPT], self._samples[:_KEPT]

    def at(self, capture_ns: int) -> PoseSample:
        """Return the pose of the left camera at the time of a frame.

        Raises BadPose: the frame is before or after all poses, or in a gap.
        """
        t_ns = capture_ns + self._offset_ns
        with self._turn:
            first_ns, last_ns = self._times_ns[0], self._times_ns[-1]
            after = bisect.bisect_left(self._times_ns, t_ns)
            times_ns = self._times_ns[max(after - 1, 0) : after + 1]
            samples = self._samples[max(after - 1, 0) : after + 1]
        if t_ns > last_ns:
            raise _outside(t_ns - last_ns, "after the latest")
        if t_ns < first_ns:
            raise _outside(first_ns - t_ns, "before the earliest")
        if times_ns[-1] == t_ns:
            return self._of_left(samples[-1])
        if times_ns[1] - times_ns[0] > _LONGEST_GAP_NS:
            gap_ms = (times_ns[1] - times_ns[0]) * 1e-6
            raise BadPose(
                f"the frame is in a gap of {gap_ms:.0f} ms between two poses, and motion is only "
                f"interpolated over {_LONGEST_GAP_NS * 1e-6:.0f} ms; track more poses"
            )
        share = (t_ns - times_ns[0]) / (times_ns[1] - times_ns[0])
        return self._of_left(_between(samples[0], samples[1], share))

    def _of_left(self, sample: PoseSample) -> PoseSample:
        if self._tracked_from_left is None:
            return sample
        world_from_left = sample.world_from_left @ self._tracked_from_left
        return PoseSample(
            world_from_left, sample.orientation_valid, sample.position_valid, sample.tracked
        )


def _outside(away_ns: int, where: str) -> BadPose:
    return BadPose(
        f"the frame is {away_ns * 1e-6:.1f} ms {where} pose of the session; track poses around its "
        "time first, give the pose with the frame, or correct pose_offset_s"
    )


def _between(start: PoseSample, end: PoseSample, share: float) -> PoseSample:
    """Interpolate: rotation by slerp, position linearly. What one of them lacks is not valid."""
    before, after = start.world_from_left, end.world_from_left
    moved_m = after.translation_m - before.translation_m
    pose = Pose.from_xyzw(
        _slerp(before.orientation_xyzw, after.orientation_xyzw, share),
        before.translation_m + share * moved_m,
    )
    return PoseSample(
        pose,
        start.orientation_valid and end.orientation_valid,
        start.position_valid and end.position_valid,
        start.tracked and end.tracked,
    )


def _slerp(start_xyzw: Matrix, end_xyzw: Matrix, share: float) -> Matrix:
    cosine = float(start_xyzw @ end_xyzw)
    if cosine < 0:  # the same rotation, the short way round
        end_xyzw, cosine = -end_xyzw, -cosine
    if cosine > _NEARLY_EQUAL:
        mixed: Matrix = start_xyzw + share * (end_xyzw - start_xyzw)
    else:
        angle = np.arccos(cosine)
        mixed = np.sin((1 - share) * angle) * start_xyzw + np.sin(share * angle) * end_xyzw
    unit: Matrix = mixed / np.linalg.norm(mixed)
    return unit
