"""Mistakes in a stereo recording, found by what its own images say.

Features are matched between left and right, and between left images up to a second apart.
The first say whether rows correspond; with the depth that follows from them, the poses say where
each feature must be seen next. A mistake is reported where one change of the rig or of the poses
explains what is seen far better than the recording as it is.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from vergence_proto.datasets import StereoSource
from vergence_proto.datasets.poses import interpolated
from vergence_proto.geometry import Axes, Pose
from vergence_proto.types import Distortion, Image, Intrinsics, StereoRig

Points = NDArray[np.float64]

# How far apart in time the frames of a pair are.
_APART_S = 1.0
_APART_SHARE = 0.6  # of a short recording
_FEATURES = 1500
_RATIO = 0.75  # Lowe's ratio test
# The right image is compared with the left one of so many frames before and after, too.
_SHIFTS = (-2, -1, 1, 2)
# A mistake must leave at least this error, and its remedy at most this share of it.
_NOTICED_PX = 0.6
_REMEDY_SHARE = 0.6
_VERTICAL_PX = 0.7
_LEAST_DISPARITY_PX = 0.5
_SWAPPED_SHARE = 0.8
_OFFSETS_S = tuple(np.round(np.arange(-0.2, 0.2001, 0.01), 3))
_SCALES = tuple(np.round(np.exp(np.linspace(np.log(0.7), np.log(1.45), 45)), 4))


class Mistake(StrEnum):
    """What can be wrong with a recording."""

    SWAPPED_EYES = "swapped eyes"
    VERTICAL = "vertical misalignment"
    EYES_APART_IN_TIME = "left and right apart in time"
    AXES = "axes of the poses"
    INVERTED_POSES = "inverted poses"
    POSE_TIME = "time of the poses"
    BASELINE = "baseline"
    FOCAL_LENGTH = "focal length"


@dataclass(frozen=True, slots=True)
class Advice:
    """One mistake, and what to do about it."""

    mistake: Mistake
    """The kind of mistake."""
    sentence: str
    """What was seen, and what to change."""


def check_source(source: StereoSource, *, pairs: int = 10) -> list[Advice]:
    """Look for mistakes; an empty list means that the images contradict nothing.

    Of a recording without poses, only what the two images of a frame say is checked. The first
    mistake found is reported: others may appear when it is mended.

    Parameters
    ----------
    source
        The recording. Some of its frames are read.
    pairs
        The number of pairs of frames to look at; more are slower, and surer in poor light.

    Raises
    ------
    DatasetError
        An image is missing or damaged.
    """
    if not len(source):
        return []
    recording = _Recording(source, pairs)
    found = _swapped(recording) or _rows(recording) or _motion(recording)
    return [] if found is None else [found]


@dataclass(frozen=True, slots=True)
class _Matches:
    """Features of a left image that were found in a right one: rays x / z, y / z, rectified."""

    left: Points  # [N, 2]
    right: Points  # [N, 2]
    later: Points  # [N, 2], in the later left image; NaN where it was not found


@dataclass(frozen=True, slots=True)
class _Features:
    points: Points  # [N, 2], rays
    descriptors: NDArray[np.float32]  # [N, 128]


class _Recording:
    """The matches of some pairs of frames, made when they are asked for."""

    def __init__(self, source: StereoSource, pairs: int) -> None:
        self.source = source
        self.pairs = _frame_pairs([each.capture_ns for each in source.files], pairs)
        self.focal_px = source.rig.left.fx
        self.baseline_m = float(np.linalg.norm(source.rig.left_from_right.translation_m))
        self.turns = _rectifying_rotations(source.rig)
        self._detector = cv2.SIFT.create(nfeatures=_FEATURES)
        self._features: dict[tuple[int, int], _Features] = {}
        self._matches: dict[tuple[int, int, int], _Matches] = {}

    def matches(self, first: int, second: int, shift: int = 0) -> _Matches | None:
        """Match two left images, and the first with the right image of ``shift`` frames later.

        None: there is no such right image.
        """
        if not 0 <= first + shift < len(self.source):
            return None
        key = first, second, shift
        if key not in self._matches:
            left, later = self._of(first, 0), self._of(second, 0)
            right = self._of(first + shift, 1)
            onward = dict(_matched(left, later)) if second != first else {}
            found = _matched(left, right)
            nowhere = (np.nan, np.nan)
            after = [later.points[onward[a]] if a in onward else nowhere for a, _ in found]
            self._matches[key] = _Matches(
                left.points[[a for a, _ in found]],
                right.points[[b for _, b in found]],
                np.array(after, np.float64).reshape(-1, 2),
            )
        return self._matches[key]

    def all_matches(self, shift: int = 0) -> Iterator[_Matches]:
        """Iterate over the matches of every pair that has some."""
        found = (self.matches(*pair, shift) for pair in self.pairs)
        return (each for each in found if each is not None)

    def _of(self, index: int, side: int) -> _Features:
        if (index, side) not in self._features:
            frame = self.source[index].frame
            image = (frame.left, frame.right)[side]
            camera = (self.source.rig.left, self.source.rig.right)[side]
            found = _features(self._detector, image, camera, self.turns[side])
            self._features[index, side] = found
        return self._features[index, side]


def _frame_pairs(times_ns: list[int], pairs: int) -> list[tuple[int, int]]:
    """Frames to look at, each with the first one that is late enough after it."""
    times_s = np.array(times_ns) * 1e-9
    apart_s = min(_APART_S, _APART_SHARE * (times_s[-1] - times_s[0]))
    later = np.searchsorted(times_s, times_s + apart_s)
    firsts = np.nonzero(later < len(times_s))[0]
    chosen = np.unique(firsts[np.linspace(0, firsts.size - 1, pairs).round().astype(int)])
    return [(int(first), int(later[first])) for first in chosen]


def _features(
    detector: cv2.SIFT, image: Image, camera: Intrinsics, turn: NDArray[np.float64]
) -> _Features:
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    found, descriptors = detector.detectAndCompute(grey, None)
    pixels = np.array([each.pt for each in found], np.float64).reshape(-1, 2)
    rays = _rays(camera, pixels) @ turn.T
    if descriptors is None:
        descriptors = np.zeros((0, 128), np.float32)
    return _Features(rays[:, :2] / rays[:, 2:], np.asarray(descriptors, np.float32))


def _rays(camera: Intrinsics, pixels: Points) -> NDArray[np.float64]:
    if not len(pixels):
        return np.zeros((0, 3))
    coefficients = np.array(camera.coefficients)
    undistort = (
        cv2.fisheye.undistortPoints
        if camera.distortion is Distortion.KANNALA_BRANDT
        else cv2.undistortPoints
    )
    flat = undistort(pixels[:, None], camera.matrix, coefficients).reshape(-1, 2)
    return np.column_stack([flat, np.ones(len(flat))])


def _rectifying_rotations(rig: StereoRig) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotations of the left and the right camera after which their rows correspond."""
    if rig.as_rectified() is not None:
        return np.eye(3), np.eye(3)
    right_from_left = rig.left_from_right.inverse()
    size = (rig.left.width, rig.left.height)
    left, right, *_ = cv2.stereoRectify(
        rig.left.matrix,
        np.zeros(4),
        rig.right.matrix,
        np.zeros(4),
        size,
        right_from_left.rotation,
        right_from_left.translation_m[:, None],
    )
    return np.asarray(left, np.float64), np.asarray(right, np.float64)


def _matched(a: _Features, b: _Features) -> list[tuple[int, int]]:
    """Pairs that are each other's nearest and clearly nearer than the next."""
    if len(a.descriptors) < 2 or len(b.descriptors) < 2:
        return []
    matcher = cv2.BFMatcher(cv2.NORM_L2)

    def nearest(query: _Features, train: _Features) -> dict[int, int]:
        found = matcher.knnMatch(query.descriptors, train.descriptors, k=2)
        return {
            best.queryIdx: best.trainIdx
            for best, second in found
            if best.distance < _RATIO * second.distance
        }

    there, back = nearest(a, b), nearest(b, a)
    return [(i, j) for i, j in there.items() if back.get(j) == i]


def _swapped(recording: _Recording) -> Advice | None:
    disparity_px = np.concatenate([_disparity(each) for each in recording.all_matches()])
    disparity_px *= recording.focal_px
    if disparity_px.size and (disparity_px < -1).mean() > _SWAPPED_SHARE:
        return Advice(
            Mistake.SWAPPED_EYES,
            f"{(disparity_px < -1).mean():.0%} of the points lie farther to the right in the right "
            "image, so the images are swapped: exchange left and right",
        )
    return None


def _rows(recording: _Recording) -> Advice | None:
    """Rows that do not correspond: by a tilt, or because the images are of different times."""
    rows_px = _row_differences_px(recording, 0)
    off_px = _typical(rows_px)
    if not rows_px.size or off_px < _VERTICAL_PX:
        return None
    middle_px = float(np.median(rows_px))
    tilt_left_px = _typical(rows_px - middle_px)
    left_px = {shift: _typical(_row_differences_px(recording, shift)) for shift in _SHIFTS}
    shift = min(left_px, key=lambda shift: left_px[shift])
    if left_px[shift] < min(tilt_left_px, _REMEDY_SHARE * off_px):
        return _apart_in_time(recording, shift, off_px, left_px[shift])
    if tilt_left_px < _REMEDY_SHARE * off_px:
        pitch_deg = abs(np.degrees(np.arctan(middle_px / recording.focal_px)))
        return Advice(
            Mistake.VERTICAL,
            f"the same point is {abs(middle_px):.1f} px {'lower' if middle_px > 0 else 'higher'} "
            f"in the left image than in the right one ({pitch_deg:.2f} degrees of pitch): "
            "calibrate again, or state the rig as it is and not as a rectified one",
        )
    return None


def _motion(recording: _Recording) -> Advice | None:
    """What the poses say against what the later images show."""
    source = recording.source
    times_ns = [each.capture_ns for each in source.files]
    known = [each.world_from_left for each in source.files if each.world_from_left is not None]
    if len(known) < len(source) or len(source) < 2:
        return None
    rectified_from_left = Pose(recording.turns[0], np.zeros(3))
    baseline_m, focal_px = recording.baseline_m, recording.focal_px

    def error_px(
        poses: Sequence[Pose | None], *, baseline: float = 1.0, focal: float = 1.0, shift: int = 0
    ) -> float:
        """The typical distance between where points are expected and where they are."""
        errors = [np.zeros(0)]
        for pair in recording.pairs:
            first, second = (poses[index] for index in pair)
            matches = recording.matches(*pair, shift)
            if first is None or second is None or matches is None:
                continue
            second_from_first = (
                rectified_from_left @ second.inverse() @ first @ rectified_from_left.inverse()
            )
            disparity = _disparity(matches)
            seen = (disparity * focal_px > _LEAST_DISPARITY_PX) & np.isfinite(matches.later[:, 0])
            rays = np.column_stack([matches.left[seen] / focal, np.ones(seen.sum())])
            depth_m = baseline_m * baseline * focal / disparity[seen]
            points = second_from_first.apply(rays * depth_m[:, None])
            ahead = points[:, 2] > 0
            expected = points[ahead, :2] / points[ahead, 2:] * focal
            errors.append(np.linalg.norm(expected - matches.later[seen][ahead], axis=1))
            errors.append(np.full((~ahead).sum(), np.inf))
        return _typical(np.concatenate(errors)) * focal_px

    as_it_is = error_px(known)
    if not as_it_is > _NOTICED_PX:
        return None
    remedies: list[tuple[float, Advice]] = []

    def remedy(error: float, mistake: Mistake, what: str) -> None:
        sentence = f"{what}: then the images fit to {error:.1f} px, and as it is to {as_it_is:.1f}"
        remedies.append((error, Advice(mistake, sentence)))

    inverted = [pose.inverse() for pose in known]
    remedy(
        error_px(inverted),
        Mistake.INVERTED_POSES,
        "the poses map world to camera; store their inverses, camera to world",
    )
    for axes in Axes:
        if axes is not Axes.OPENCV:
            remedy(
                error_px([axes.to_opencv(pose) for pose in known]),
                Mistake.AXES,
                f"the poses have the axes {axes.name}; convert them, or open the session with them",
            )
    offset_s = min(_OFFSETS_S, key=lambda offset: error_px(_shifted(times_ns, known, offset)))
    remedy(
        error_px(_shifted(times_ns, known, offset_s)),
        Mistake.POSE_TIME,
        f"the poses are {abs(offset_s) * 1000:.0f} ms {'early' if offset_s > 0 else 'late'}; take "
        f"the pose at the time of the image {offset_s * 1000:+.0f} ms",
    )
    scale = min(_SCALES, key=lambda scale: error_px(known, baseline=scale))
    remedy(
        error_px(known, baseline=scale),
        Mistake.BASELINE,
        f"the baseline is {baseline_m * scale * 1000:.0f} mm and not {baseline_m * 1000:.0f} mm, "
        f"or the lengths of the poses are off by a factor of {1 / scale:.2f}",
    )
    scale = min(_SCALES, key=lambda scale: error_px(known, focal=scale))
    remedy(
        error_px(known, focal=scale),
        Mistake.FOCAL_LENGTH,
        f"the focal length is {focal_px * scale:.0f} px and not {focal_px:.0f} px; it changes with "
        "the size of the images",
    )
    shift = min(_SHIFTS, key=lambda shift: error_px(known, shift=shift))
    error = error_px(known, shift=shift)
    remedies.append((error, _apart_in_time(recording, shift, as_it_is, error)))

    error, advice = min(remedies, key=lambda each: each[0])
    return advice if error < _REMEDY_SHARE * as_it_is else None


def _apart_in_time(recording: _Recording, shift: int, as_it_is: float, error: float) -> Advice:
    frame_ms = float(np.median(np.diff([each.capture_ns for each in recording.source.files])))
    frames = "1 frame" if abs(shift) == 1 else f"{abs(shift)} frames"
    return Advice(
        Mistake.EYES_APART_IN_TIME,
        f"the right images were taken {abs(shift) * frame_ms * 1e-6:.0f} ms ({frames}) "
        f"{'before' if shift > 0 else 'after'} the left ones: pair the images by their times; then "
        f"they fit to {error:.1f} px, and as it is to {as_it_is:.1f}",
    )


def _shifted(times_ns: list[int], poses: list[Pose], offset_s: float) -> list[Pose | None]:
    return [interpolated(times_ns, poses, time_ns + round(offset_s * 1e9)) for time_ns in times_ns]


def _disparity(matches: _Matches) -> NDArray[np.float64]:
    return matches.left[:, 0] - matches.right[:, 0]


def _row_differences_px(recording: _Recording, shift: int) -> NDArray[np.float64]:
    differences = [each.left[:, 1] - each.right[:, 1] for each in recording.all_matches(shift)]
    return np.concatenate([np.zeros(0), *differences]) * recording.focal_px


def _typical(values: NDArray[np.float64]) -> float:
    return float(np.median(np.abs(values))) if values.size else np.inf
