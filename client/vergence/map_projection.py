"""One disparity map on its way into another camera: forward for its surfaces, back for its values.

Pixels of the map are (u, v, disparity); those of the view are (x, y, 1 / depth). Both ways are one
projective 4x4 matrix.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from vergence_proto.types import Plane

Value = TypeVar("Value", bound=np.generic)
Mask = NDArray[np.bool_]

# The forward pass works on every second pixel of the map and of the view.
STEP = 2
# Samples of two surfaces are not mixed if they differ by more, in pixels of disparity.
EDGE_PX = np.float32(0.5)
# A surface that was looked up belongs to a pixel of the view if it lands no farther from it.
_MISS_PX = np.float32(1.5)
# How often the points that lost a pixel to a farther one are written again before they are sorted.
_TRIES = 8
# Pixels that are looked up at a time.
_CHUNK = 20_000
_CORNERS = np.ones((2, 2), np.uint8)
_AROUND = np.ones((3, 3), np.uint8)


class Found(NamedTuple):
    """What a map says of the pixels of a view."""

    inverse_depth: Plane  # 1 / metres; 0: nothing
    covered: Mask  # the map has a value there
    sigma: Plane | None  # 1 / metres; None: the map has none


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """A map and the way from its pixels to those of a view."""

    disparity_px: Plane
    sigma_px: Plane | None
    xyq_from_uvd: NDArray[np.float32]  # [4, 4], homogeneous
    uvd_from_xyq: NDArray[np.float32]  # its inverse
    edge: np.float32  # a step of 1 / depth that is no slope of one surface, in 1 / metres
    age_s: float
    motion_m: float  # how far things may have moved since

    def splat(self, rows: int, columns: int, *, wanted: Mask | None = None) -> Plane:
        """Forward-project every second pixel onto every second pixel of the view.

        Returns the nearest surface as float32 [rows, columns], 1 / metres; 0: none. Away from the
        ``wanted`` pixels it may be 0.
        """
        import cv2  # here: loading it takes longer than the rest of the client

        height, width = self.disparity_px.shape
        disparity_px = np.ascontiguousarray(self.disparity_px[STEP // 2 :: STEP, STEP // 2 :: STEP])
        matrix = self.xyq_from_uvd
        padded = columns + 2  # a column and a row on either side catch what falls outside
        u = np.arange(STEP // 2, width, STEP, dtype=np.float32)[None, :]
        v = np.arange(STEP // 2, height, STEP, dtype=np.float32)[:, None]
        x, y, q, w = _products(matrix, u, v)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            # NaN and what lies behind the camera fail every comparison below.
            w += matrix[3, 2] * disparity_px
            np.reciprocal(w, out=w)
            q += matrix[2, 2] * disparity_px
            q *= w
            seen = (w > 0) & (q > 0) & (q < np.inf) & (disparity_px > 0)
            w *= np.float32(1 / STEP)
            index = np.zeros(q.shape, np.int32)
            for plane, row, limit in ((y, matrix[1], rows + 1), (x, matrix[0], columns + 1)):
                plane += row[2] * disparity_px
                plane *= w
                plane += np.float32(0.5 / STEP + 0.5)
                np.clip(plane, 0, limit, out=plane)
                index *= np.int32(padded)
                index += plane.astype(np.int32)
        if wanted is not None:
            around = cv2.dilate(wanted.view(np.uint8), _AROUND)
            framed = cv2.copyMakeBorder(around, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=(0,))
            # The index of a point that is not seen is arbitrary.
            seen &= framed.reshape(-1).take(index, mode="clip").view(np.bool_)
        points = np.flatnonzero(seen)
        index, q = index.reshape(-1).take(points), q.reshape(-1).take(points)
        nearest = _greatest(index, q, (rows + 2) * padded).reshape(rows + 2, padded)
        # Each point lies between four pixels of the view, and is seen in all of them.
        nearest = np.asarray(cv2.dilate(nearest, _CORNERS, anchor=(1, 1)), np.float32)
        return np.ascontiguousarray(nearest[1 : rows + 1, 1 : columns + 1])

    def look_up(self, x: Plane, y: Plane, guess: Plane) -> Found:
        """Read the map where pixels (x, y) of the view came from.

        ``guess`` is their inverse depth, [H, W]; ``x`` is [1, W] or [H, W], ``y`` is [H, 1]. Where
        the map has no value, the guess stays.
        """
        back, forward = self.uvd_from_xyq, self.xyq_from_uvd[:, 2]
        by_x = _times(back[:, 0], x)
        by_y = _times(back[:, 1], y) + back[:, 3, None, None]
        # A disparity that is off by d moves the pixel by (forward - forward[3] * (x, y)) * d.
        across, along = np.abs(forward[0] - forward[3] * x), np.abs(forward[1] - forward[3] * y)
        height, width = guess.shape
        found = Found(
            np.empty((height, width), np.float32),
            np.empty((height, width), np.bool_),
            None if self.sigma_px is None else np.empty((height, width), np.float32),
        )
        # Band by band: the intermediate planes stay in the processor's cache.
        rows = max(1, _CHUNK // max(width, 1))
        listed = len(x) > 1
        for top in range(0, height, rows):
            band = slice(top, top + rows)
            self._look_up_band(
                by_x[:, band] if listed else by_x,
                by_y[:, band],
                np.maximum(across[band] if listed else across, along[band]),
                guess[band],
                Found(
                    found.inverse_depth[band],
                    found.covered[band],
                    None if found.sigma is None else found.sigma[band],
                ),
            )
        return found

    def _look_up_band(
        self,
        by_x: NDArray[np.float32],
        by_y: NDArray[np.float32],
        moves: Plane,
        guess: Plane,
        found: Found,
    ) -> None:
        """Write to ``found`` what the map says of the pixels of a band."""
        import cv2  # here: loading it takes longer than the rest of the client

        per_guess, forward = self.uvd_from_xyq[:, 2], self.xyq_from_uvd[:, 2]
        u, v, d, w = (x + y for x, y in zip(by_x, by_y, strict=True))
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            scratch = guess * per_guess[3]
            w += scratch
            reciprocal = np.reciprocal(w)
            for plane, factor in ((u, per_guess[0]), (v, per_guess[1])):
                plane += np.multiply(guess, factor, out=scratch)
                plane *= reciprocal
            d += np.multiply(guess, per_guess[2], out=scratch)
            outside = (np.nan,)
            read = cv2.remap(self.disparity_px, u, v, cv2.INTER_NEAREST, borderValue=outside)
            smooth = cv2.remap(self.disparity_px, u, v, cv2.INTER_LINEAR, borderValue=outside)
            np.abs(np.subtract(smooth, read, out=scratch), out=scratch)
            # Copies with a mask are many times faster in OpenCV than in numpy.
            cv2.copyTo(smooth, (scratch < EDGE_PX).view(np.uint8), read)  # false for NaN
            # With the disparity of the guess, d / w, it goes forward to (x, y, guess, 1) / w: only
            # the change of the disparity has to be added.
            useful = (read > 0) & (guess > 0) & (w > 0)
            change = np.multiply(read, w, out=read)
            change -= d
            scale = np.multiply(change, forward[3], out=scratch)
            scale += np.float32(1)
            q = change * forward[2]
            q += guess
            q /= scale
            useful &= q > 0
            # Beside an edge the map can have another surface there, which belongs to another pixel
            # of the view.
            np.abs(change, out=change)
            change *= moves
            np.less(change, scale * _MISS_PX, out=found.covered)
            np.logical_and(found.covered, useful, out=found.covered)
            # Of two surfaces neither of which is seen there, the farther one is more likely.
            refined = np.minimum(q, guess, out=found.inverse_depth)
            cv2.copyTo(guess, (~useful).view(np.uint8), refined)
            cv2.copyTo(q, found.covered.view(np.uint8), refined)
            if self.sigma_px is None or found.sigma is None:
                return
            read = cv2.remap(self.sigma_px, u, v, cv2.INTER_NEAREST, borderValue=(0.0,))
            # The change of q with the disparity, and that by what moves.
            own = np.asarray(read, np.float32) * (forward[2] - q * forward[3])
            own *= w
            own /= scale
            q *= q
            q *= np.float32(self.motion_m)
            np.sqrt(own * own + q * q, out=found.sigma)


def repeated(half: NDArray[Value]) -> NDArray[Value]:
    """Repeat every pixel in both directions."""
    import cv2  # here: loading it takes longer than the rest of the client

    size = half.shape[1] * STEP, half.shape[0] * STEP
    plane: Any = half.view(np.uint8) if half.dtype == np.bool_ else half
    return np.asarray(cv2.resize(plane, size, interpolation=cv2.INTER_NEAREST)).view(half.dtype)


def _products(matrix: NDArray[np.float32], x: Plane, y: Plane) -> list[Plane]:
    """The part of ``matrix @ (x, y, *, 1)`` that depends on the pixel alone, row by row."""
    return [row[0] * x + (row[1] * y + row[3]) for row in matrix]


def _times(factors: NDArray[np.float32], plane: Plane) -> NDArray[np.float32]:
    return factors[:, None, None] * plane


def _greatest(
    index: NDArray[np.int32], values: NDArray[np.float32], size: int
) -> NDArray[np.float32]:
    """Return the greatest of the values of each index; 0 where there is none.

    Of the values that are written to one place the last one stays. The few that lost to a smaller
    one are written again, which is many times faster than a sort of all.
    """
    greatest = np.zeros(size, np.float32)
    places = index.astype(np.intp)  # once: an array of int32 is converted at each use
    for _ in range(_TRIES):
        greatest[places] = values
        lost = np.flatnonzero(values > greatest.take(places))
        if not lost.size:
            return greatest
        places, values = places.take(lost), values.take(lost)
    order = np.argsort(values)
    greatest[places[order]] = values[order]
    return greatest
