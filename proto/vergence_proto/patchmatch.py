"""PatchMatch stereo: a slanted plane for every pixel, found by guessing and by asking neighbours.

The planes, the cost and the left-right check are those of *PatchMatch Stereo* (Bleyer, Rhemann,
Rother; BMVC 2011), on images of half the size. Pixels take turns like the squares of a chess board
(*Gipuma*: Galliani, Lasinger, Schindler; ICCV 2015), so all squares of a colour are one array. In a
video, the planes of the last frame are moved to the new view and improved.

A plane is three numbers at its pixel: disparity, and its change per pixel to the right and down.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Plane = NDArray[np.float32]  # [h, w]
Planes = NDArray[np.float32]  # [3, h, w]: disparity, slope to the right, slope down
Image = NDArray[np.uint8]

SCALE = 2  # pixels of the image per pixel of the search
UNKNOWN_SIGMA_PX = 27.0  # nothing was matched in the whole row
_HOLE_SIGMA_PX = 4.0
# Of matches: fitted to the errors on the bundled room.
_NOISE, _SIGMA_OF_DOUBT = 0.1, 0.3
_LEAST_SIGMA_PX, _MOST_SIGMA_PX = 0.15, 2.0

_REACH, _SPACING = 8, 4  # the window is sampled at every fourth pixel
_LIKENESS = 20.0  # a pixel that differs by so many levels has 1/e of a say
# Brightness and gradient: their shares of the cost, and the difference from which it is constant.
_SHARES, _MOST = (0.3, 0.7), (10.0, 4.0)
_OUTSIDE = 1e4  # a value that no pixel has

_NEIGHBOURS = ((0, 1), (0, -1), (1, 0), (-1, 0), (0, 5), (0, -5), (5, 0), (-5, 0))
_CHANGES = ((8.0, 0.3), (2.0, 0.2), (0.5, 0.1), (0.15, 0.03))  # of disparity and of slopes
_FIRST_GUESSES = 4
_CHECK_ITERATIONS = 1  # of the right view, which starts from the planes of the left one
_STEEPEST = 1.0
_CONSISTENT_PX = 1.0
_LEAST_RISE = 0.02  # of the cost, one pixel beside the match: less is no texture


class Matches(NamedTuple):
    """What was found in a pair, in px of the full image."""

    disparity_px: Plane  # [H, W], dense
    sigma_px: Plane  # [H, W], its expected absolute error
    matched: NDArray[np.bool_]  # [H, W]; elsewhere a neighbour's plane goes on
    planes: Planes  # [3, H / 2, W / 2], the start of the next frame


def patchmatch(
    left: Image,
    right: Image,
    *,
    max_disparity_px: int,
    iterations: int = 3,
    previous: Planes | None = None,
    uvd_curr_from_prev: NDArray[np.float32] | None = None,
) -> Matches:
    """Match a pair [H, W, 3]; H is a multiple of 2, and W of 4.

    ``previous`` are the planes of the last frame; ``uvd_curr_from_prev`` moves its pixels and
    disparities to this one (see :func:`vergence_proto.geometry.uvd_curr_from_prev`).
    """
    height, width = left.shape[:2]
    half = (width // SCALE, height // SCALE)
    eyes = [
        np.asarray(cv2.resize(each, half, interpolation=cv2.INTER_AREA), np.uint8)
        for each in (left, right)
    ]
    range_px = max_disparity_px / SCALE
    start = None
    if previous is not None:
        motion = np.eye(4) if uvd_curr_from_prev is None else uvd_curr_from_prev
        start = moved(previous, _HALF @ motion @ np.linalg.inv(_HALF))
    search = _Search(eyes[0], eyes[1], range_px)
    search.run(start, iterations)
    planes, cost = search.planes, search.costs
    rise = search.rise()
    # The right view is the left one of the pair in a mirror.
    to_right = np.array([[-1, 0, 1, half[0] - 1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    mirrored = [np.ascontiguousarray(each[:, ::-1]) for each in eyes]
    search = _Search(mirrored[1], mirrored[0], range_px)
    search.run(moved(planes, to_right), _CHECK_ITERATIONS)
    matched = _consistent(planes[0], search.planes[0][:, ::-1]) & (rise > _LEAST_RISE)
    planes = _continued(planes, matched)
    sigma = _sigma_of(cost, rise, matched)
    smooth = cv2.medianBlur(planes[0], 5)
    disparity = np.asarray(cv2.resize(smooth, (width, height)), np.float32) * np.float32(SCALE)
    sigma = np.asarray(cv2.resize(sigma, (width, height)), np.float32)
    seen = cv2.resize(matched.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
    return Matches(disparity, sigma, seen.astype(np.bool_), planes)


class _Search:
    """The planes of one view, and their costs."""

    def __init__(self, image: Image, other: Image, range_px: float) -> None:
        self._range_px = range_px
        self._random = np.random.default_rng(0)  # a frame gives the same answer every time
        self._other = _features(other)
        self.planes: Planes = np.zeros((3, *image.shape[:2]), np.float32)
        self.costs: Plane = np.full(image.shape[:2], np.inf, np.float32)
        own, guide = _features(image), image.astype(np.float32)
        steps = range(-_REACH, _REACH + 1, _SPACING)
        self._window = [*product(steps, steps)]
        likeness: list[Plane] = [
            np.asarray(np.exp(np.abs(_shifted(guide, by) - guide).mean(axis=2) / -_LIKENESS))
            for by in self._window
        ]
        total = np.asarray(np.sum(likeness, axis=0), np.float32)
        at = np.indices(self.costs.shape, np.float32)
        self._at = [(_squares(at[0], colour), _squares(at[1], colour)) for colour in (0, 1)]
        weights = [np.asarray(like / total, np.float32) for like in likeness]
        self._weights = [[_squares(each, colour) for each in weights] for colour in (0, 1)]
        self._own = [
            [[_squares(_shifted(each, by), colour) for each in own] for by in self._window]
            for colour in (0, 1)
        ]

    def run(self, start: Planes | None, iterations: int) -> None:
        """Start from planes, which may be NaN, or from guesses."""
        guess = self._guess()
        self._offer_all(guess if start is None else np.where(np.isnan(start), guess, start))
        for _ in range(_FIRST_GUESSES if start is None else 1):
            self._offer_all(self._guess())
        for _, colour in product(range(iterations), (0, 1)):
            for down, right in _NEIGHBOURS:
                theirs = np.roll(self.planes, (-down, -right), axis=(1, 2))
                theirs[0] -= right * theirs[1] + down * theirs[2]
                self._offer(_squares(theirs, colour), colour)
            for sizes in _CHANGES:
                own = _squares(self.planes, colour)
                change = self._random.uniform(-1, 1, own.shape).astype(np.float32)
                self._offer(own + change * _column(sizes[0], sizes[1], sizes[1]), colour)

    def rise(self) -> Plane:
        """Return how much more the planes one pixel nearer or farther cost, the lesser of both."""
        rise = np.empty_like(self.costs)
        for colour in (0, 1):
            own = _squares(self.planes, colour)
            beside = [self._cost(own + _column(by, 0, 0), colour) for by in (-1, 1)]
            _put(rise, np.minimum(*beside) - _squares(self.costs, colour), colour)
        return rise

    def _guess(self) -> Planes:
        guess = self._random.random(self.planes.shape, np.float32)
        return (guess - _column(0, 0.5, 0.5)) * _column(self._range_px, 0.4, 0.4)

    def _offer_all(self, planes: Planes) -> None:
        for colour in (0, 1):
            self._offer(_squares(planes, colour), colour)

    def _offer(self, planes: Planes, colour: int) -> None:
        """Take the planes that cost less."""
        limit = _column(self._range_px, _STEEPEST, _STEEPEST)
        planes = np.clip(planes, _column(0, -_STEEPEST, -_STEEPEST), limit)
        cost, before = self._cost(planes, colour), _squares(self.costs, colour)
        better = cost < before
        _put(self.planes, np.where(better, planes, _squares(self.planes, colour)), colour)
        _put(self.costs, np.where(better, cost, before), colour)

    def _cost(self, planes: Planes, colour: int) -> Plane:
        """The mean difference in the window, of pixels that are alike."""
        disparity, slope_right, slope_down = planes
        rows, columns = self._at[colour]
        seen_at = columns - disparity
        total: Plane = np.zeros_like(disparity)
        for (down, right), own, weight in zip(
            self._window, self._own[colour], self._weights[colour], strict=True
        ):
            column = seen_at + (right - right * slope_right - down * slope_down)
            row = rows + np.float32(down)
            apart = [
                np.minimum(np.abs(_sampled(there, column, row) - here), share * most)
                for here, there, share, most in zip(own, self._other, _SHARES, _MOST, strict=True)
            ]
            total += weight * (apart[0] + apart[1])
        return total


def moved(planes: Planes, matrix: NDArray[np.floating]) -> Planes:
    """Move planes by a matrix of (u, v, disparity, 1); the nearest wins, NaN where none arrives."""
    height, width = planes.shape[1:]
    v, u = np.indices((height, width), np.float64)
    disparity, right, down = planes.astype(np.float64)
    points = np.stack([u, v, disparity, np.ones_like(u)]).reshape(4, -1)
    # The plane is all points whose product with its row is zero.
    rows = np.stack([right, down, -np.ones_like(u), disparity - right * u - down * v])
    rows = np.linalg.inv(matrix).T @ rows.reshape(4, -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        to = matrix @ points
        in_front = to[3] > 0
        to_u, to_v, to_d = np.nan_to_num(to[:3] / to[3], nan=-1, posinf=-1, neginf=-1)
        right, down, offset = -rows[[0, 1, 3]] / rows[2]
        column, row = np.rint(to_u), np.rint(to_v)
        values = np.stack([right * column + down * row + offset, right, down])
    usable = in_front & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    usable &= np.isfinite(values).all(axis=0) & (np.abs(values[1:]) <= _STEEPEST).all(axis=0)
    order = np.argsort(to_d, kind="stable")
    order = order[usable[order]]
    result = np.full(planes.shape, np.nan, np.float32)
    result[:, row[order].astype(np.int64), column[order].astype(np.int64)] = values[:, order]
    return result


# From pixels of the full image to those of the search, whose centres lie between four.
_HALF = np.array([[0.5, 0, 0, -0.25], [0, 0.5, 0, -0.25], [0, 0, 0.5, 0], [0, 0, 0, 1]])


def _consistent(disparity: Plane, other: Plane) -> NDArray[np.bool_]:
    """Whether the right view finds the same disparity where the left one points to."""
    columns = np.arange(disparity.shape[1], dtype=np.float32)
    there = np.rint(columns - disparity).astype(np.int64)
    found = np.take_along_axis(other, np.maximum(there, 0), axis=1)
    consistent: NDArray[np.bool_] = (there >= 0) & (np.abs(found - disparity) <= _CONSISTENT_PX)
    return consistent


def _sigma_of(cost: Plane, rise: Plane, matched: NDArray[np.bool_]) -> Plane:
    """The expected error: a match that costs much, or little less than those beside it, is wide."""
    doubt = (cost + _NOISE) / np.maximum(rise, _LEAST_RISE)
    sigma = np.clip(_SIGMA_OF_DOUBT * doubt, _LEAST_SIGMA_PX, _MOST_SIGMA_PX)
    sigma = np.where(matched, sigma, _HOLE_SIGMA_PX)
    return np.where(matched.any(axis=1, keepdims=True), sigma, UNKNOWN_SIGMA_PX).astype(np.float32)


def _continued(planes: Planes, matched: NDArray[np.bool_]) -> Planes:
    """Continue the farther of the two nearest matched planes of the row where none was matched."""
    width = matched.shape[1]
    columns = np.arange(width)
    before = np.maximum.accumulate(np.where(matched, columns, -1), axis=1)
    after = np.minimum.accumulate(np.where(matched, columns, width)[:, ::-1], axis=1)[:, ::-1]
    sides = []
    for nearest in (before, after):
        known = (nearest >= 0) & (nearest < width)
        theirs = np.take_along_axis(planes, np.clip(nearest, 0, width - 1)[None], axis=2)
        theirs[0] += theirs[1] * (columns - nearest)
        theirs[0] = np.where(known, np.maximum(theirs[0], 0), np.inf)
        sides.append(theirs)
    farther = np.where(sides[0][0] <= sides[1][0], *sides)
    farther[:, ~np.isfinite(farther[0])] = 0  # nothing is known in the whole row
    return np.where(matched, planes, farther).astype(np.float32)


def _features(image: Image) -> tuple[Plane, Plane]:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    gradient = cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=1 / 8)
    brightness, gradient_share = (np.float32(share) for share in _SHARES)
    return np.multiply(grey, brightness), np.multiply(gradient, gradient_share)


def _sampled(image: Plane, columns: Plane, rows: Plane) -> Plane:
    edge = cv2.BORDER_CONSTANT
    found = cv2.remap(image, columns, rows, cv2.INTER_LINEAR, borderMode=edge, borderValue=_OUTSIDE)
    return np.asarray(found, np.float32)


def _shifted(image: NDArray[np.float32], by: tuple[int, int]) -> NDArray[np.float32]:
    """The pixels that lie (down, right) of each; those at the edge go on."""
    (down, right), (height, width) = by, image.shape[:2]
    rows = np.clip(np.arange(height) + down, 0, height - 1)
    columns = np.clip(np.arange(width) + right, 0, width - 1)
    return image[rows[:, None], columns]


def _squares(board: NDArray[np.float32], colour: int) -> NDArray[np.float32]:
    """The squares of one colour, [..., h, w / 2]."""
    squares = np.empty((*board.shape[:-1], board.shape[-1] // 2), np.float32)
    squares[..., 0::2, :] = board[..., 0::2, colour::2]
    squares[..., 1::2, :] = board[..., 1::2, 1 - colour :: 2]
    return squares


def _put(board: NDArray[np.float32], squares: NDArray[np.float32], colour: int) -> None:
    board[..., 0::2, colour::2] = squares[..., 0::2, :]
    board[..., 1::2, 1 - colour :: 2] = squares[..., 1::2, :]


def _column(*values: float) -> NDArray[np.float32]:
    return np.array(values, np.float32)[:, None, None]
