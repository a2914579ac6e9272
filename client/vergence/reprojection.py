"""Depth as another camera sees it: a result moved to a display's pose, field of view and time.

A result is as old as its way over the network, and the head has turned since. Its points are still
where they were: moved into the display's view, the map is as good as a new one wherever the camera
has looked (headsets do the same with colour and call it reprojection or time warp).

The method: forward-project the map at half size, nearest surface first, to learn which surface each
pixel of the view sees; then look up, at full size, where on the map that pixel came from, and read
the disparity there. The second pass removes the rounding and the fat edges of the first.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from vergence.depth_formats import d16, webxr
from vergence.results import DepthResult
from vergence_proto.errors import BadCalibration, BadPose
from vergence_proto.geometry import Pose, RectifiedRig
from vergence_proto.types import Plane

Value = TypeVar("Value", bound=np.generic)
Fill = Literal["far", "none"]
Mask = NDArray[np.bool_]

# The speed at which things other than the camera are taken to move towards it or away from it, in
# metres a second: hands and people in a room, averaged over the picture.
MOTION_M_S = 0.2

_MAX_SIDE = 16384

# The first pass works on every second pixel of the map and of the view.
_STEP = 2
# Pixels that are looked up at a time; the library's limit is 32,767.
_CHUNK = 30_000
# Samples of two surfaces are not mixed if they differ by more, in pixels of disparity.
_EDGE_PX = np.float32(0.5)
# A surface that was looked up belongs to a pixel of the view if it lands no farther from it.
_MISS_PX = np.float32(1.5)


@dataclass(frozen=True, slots=True)
class View:
    """The size and the lens of a pinhole camera to see depth with, such as one eye's display.

    Pixel centres sit at integers; row 0 is the upper one.

    Raises
    ------
    BadCalibration
        A side is not between 1 and 16384, a focal length is not positive, or a number is not
        finite.
    """

    width: int
    """Width in pixels."""
    height: int
    """Height in pixels."""
    fx: float
    """Horizontal focal length in pixels."""
    fy: float
    """Vertical focal length in pixels."""
    cx: float
    """Column of the principal point in pixels; it may lie outside the picture."""
    cy: float
    """Row of the principal point in pixels."""

    def __post_init__(self) -> None:
        if not (0 < self.width <= _MAX_SIDE and 0 < self.height <= _MAX_SIDE):
            raise BadCalibration(
                f"expected a view of 1x1 to {_MAX_SIDE}x{_MAX_SIDE} pixels, "
                f"got {self.width}x{self.height}"
            )
        numbers = (self.fx, self.fy, self.cx, self.cy)
        if not (np.isfinite(numbers).all() and self.fx > 0 and self.fy > 0):
            raise BadCalibration(
                f"expected finite numbers and positive focal lengths of a view, got "
                f"fx={self.fx} fy={self.fy} cx={self.cx} cy={self.cy}"
            )

    @classmethod
    def like(cls, rig: RectifiedRig) -> Self:
        """Return the view of a rig's left camera."""
        return cls(rig.width, rig.height, rig.fx, rig.fy, rig.cx_left, rig.cy)

    @classmethod
    def from_fov(
        cls,
        left_rad: float,
        right_rad: float,
        up_rad: float,
        down_rad: float,
        *,
        width: int,
        height: int,
    ) -> Self:
        """Make a view of four angles in radians, signed as in OpenXR's ``XrFovf``.

        Angles to the right and up are positive, so that ``left_rad`` and ``down_rad`` are negative
        for an ordinary eye.

        Raises
        ------
        BadCalibration
            The angles enclose no area or reach 90 degrees, or a side is not positive.
        """
        angles = (left_rad, right_rad, up_rad, down_rad)
        if not (np.abs(angles) < np.pi / 2).all() or left_rad >= right_rad or down_rad >= up_rad:
            raise BadCalibration(
                "expected four angles within 90 degrees with left < right and down < up, "
                f"in radians; got left={left_rad} right={right_rad} up={up_rad} down={down_rad}"
            )
        if not (width > 0 and height > 0):
            raise BadCalibration(f"expected a view of at least 1x1 pixels, got {width}x{height}")
        left, right, up, down = (float(np.tan(angle)) for angle in angles)
        fx, fy = width / (right - left), height / (up - down)
        return cls(width, height, fx, fy, -left * fx - 0.5, up * fy - 0.5)


@dataclass(frozen=True, slots=True, eq=False)
class DepthView:
    """Depth in the pixels of a :class:`View`."""

    view: View
    """The camera that sees this depth."""
    world_from_view: Pose
    """The pose of that camera, in the axes of the session."""
    depth_m: Plane
    """Float32 [H, W]: metres along the view's optical axis; NaN where nothing is known."""
    covered: Mask
    """Bool [H, W]: true where a result saw the surface; elsewhere the depth is filled or NaN."""
    sigma_m: Plane | None
    """Float32 [H, W]: the expected absolute error of ``depth_m``, which grows with the age of the
    result; where the depth is filled, the depth itself. None if the result has no sigma."""
    age_s: float
    """Seconds between the capture of the newest result in it and the time it was made for."""
    frame_id: int
    """The frame of the newest result in it."""

    def d16(
        self,
        near_m: float = 0.1,
        far_m: float = math.inf,
        *,
        reversed_z: bool = False,
        bottom_up: bool = False,
    ) -> NDArray[np.uint16]:
        """Return the depth as a 16-bit depth buffer; see :func:`vergence.depth_formats.d16`."""
        return d16(self.depth_m, near_m, far_m, reversed_z=reversed_z, bottom_up=bottom_up)

    def webxr(self, meters_per_unit: float = 0.001) -> NDArray[np.uint16]:
        """Return the depth as WebXR has it; see :func:`vergence.depth_formats.webxr`."""
        return webxr(self.depth_m, meters_per_unit)


@dataclass(frozen=True, slots=True, eq=False)
class _Map:
    """A map on its way into a view. ``uvq`` is (u, v, 1 / depth)."""

    result: DepthResult
    uvq_from_uvd: NDArray[np.float32]  # [4, 4], homogeneous: pixel and disparity to the view
    uvd_from_uvq: NDArray[np.float32]  # its inverse
    age_s: float


class _Found(NamedTuple):
    """What a map says of the pixels of a view."""

    inverse_depth: Plane  # 1 / metres; 0: nothing
    covered: Mask  # the map has a value there
    sigma: Plane | None  # 1 / metres; None: the map has none


def reproject(
    result: DepthResult,
    world_from_view: Pose,
    view: View | None = None,
    *,
    at_ns: int | None = None,
    keyframes: Sequence[DepthResult] = (),
    fill: Fill = "far",
) -> DepthView:
    """Move a result into the view of another camera, or of the same one at a later pose.

    Every point moves in six degrees of freedom, and the nearest one wins a pixel. Of the moving
    things in the scene nothing is known but that sigma grows with time.

    Parameters
    ----------
    result
        The newest result. It needs a pose.
    world_from_view
        The pose of the view in the session's axes, as the poses of the frames are.
    view
        The camera to see with; default: the left camera of the result.
    at_ns
        The time to show, on the clock of ``capture_ns``; default: that of the result.
    keyframes
        Older results, the newest first, for what the newest one does not see.
    fill
        What to give pixels that no result saw: ``"far"``, the depth of the farther neighbour in
        the row, because what comes into sight mostly lies behind; or ``"none"``, NaN.

    Raises
    ------
    BadPose
        The pose or the one of the result is missing or not finite, or no rotation.
    """
    view = view or View.like(result.rig)
    if not np.isfinite(world_from_view.matrix).all():
        raise BadPose(f"expected a finite pose, got {world_from_view.matrix.tolist()}")
    at_ns = result.capture_ns if at_ns is None else at_ns
    newest, *older = (
        _into_view(each, world_from_view, view, at_ns) for each in (result, *keyframes)
    )

    nearest = _splat(newest, view)
    found = _look_up_all(newest, _enlarged(nearest, view), view)
    inverse_depth, covered, sigma = found.inverse_depth, found.covered, found.sigma
    for keyframe in older:
        more = _splat(keyframe, view)
        added = _enlarged(more > 0, view) & ~covered
        if not added.any():
            continue
        found = _look_up_some(keyframe, _enlarged(more, view), added)
        inverse_depth[added], covered[added] = found.inverse_depth, found.covered
        if sigma is not None:  # a keyframe without sigma says nothing of its errors
            sigma[added] = found.inverse_depth if found.sigma is None else found.sigma
        np.copyto(nearest, more, where=nearest == 0)

    if fill == "far":
        if not nearest.all():
            filled = _enlarged(_filled_far(nearest), view)
            np.copyto(inverse_depth, filled, where=inverse_depth == 0)
        known = inverse_depth > 0
    else:
        known = covered
    depth_m = np.full(known.shape, np.float32(np.nan))
    np.divide(np.float32(1), inverse_depth, out=depth_m, where=known)
    if sigma is not None:  # the error of 1 / q is that of q by q squared; what is filled is unknown
        sigma *= depth_m
        sigma *= depth_m
        np.copyto(sigma, depth_m, where=~covered)
    return DepthView(view, world_from_view, depth_m, covered, sigma, newest.age_s, result.frame_id)


def _into_view(result: DepthResult, world_from_view: Pose, view: View, at_ns: int) -> _Map:
    if result.world_from_left is None:
        raise BadPose(
            f"expected a result with a pose, and frame {result.frame_id} has none; "
            "submit frames with poses to see their depth from elsewhere"
        )
    axes = result.axes
    view_from_left = axes.to_opencv(world_from_view).inverse() @ axes.to_opencv(
        result.world_from_left
    )
    uvw_from_xyz = np.array(
        [[view.fx, 0, view.cx, 0], [0, view.fy, view.cy, 0], [0, 0, 0, 1], [0, 0, 1, 0]]
    )
    uvq_from_uvd = uvw_from_xyz @ view_from_left.matrix @ _xyzw_from_uvd(result.rig)
    return _Map(
        result,
        uvq_from_uvd.astype(np.float32),
        np.linalg.inv(uvq_from_uvd).astype(np.float32),
        max(0.0, (at_ns - result.capture_ns) * 1e-9),
    )


def _xyzw_from_uvd(rig: RectifiedRig) -> NDArray[np.float64]:
    """Q for a disparity that is zero at infinity, as in ``disparity_px``."""
    matrix = rig.xyzw_from_uvd
    matrix[3, 3] = 0
    return matrix


def _products(matrix: NDArray[np.float32], x: Plane, y: Plane) -> list[Plane]:
    """The part of ``matrix @ (x, y, *, 1)`` that depends on the pixel alone, row by row."""
    return [row[0] * x + (row[1] * y + row[3]) for row in matrix]


def _splat(source: _Map, view: View) -> Plane:
    """Forward-project every second pixel onto every second pixel of the view.

    Returns the nearest surface as float32 [ceil(H / 2), ceil(W / 2)], 1 / metres; 0: none.
    """
    disparity_px = source.result.disparity_px[_STEP // 2 :: _STEP, _STEP // 2 :: _STEP]
    matrix = source.uvq_from_uvd
    rows, columns = -(-view.height // _STEP), -(-view.width // _STEP)
    padded = columns + 3  # one column to the left and two to the right catch what falls outside
    x, y = (
        np.arange(_STEP // 2, length, _STEP, dtype=np.float32)
        for length in source.result.disparity_px.shape[::-1]
    )
    u, v, q, w = _products(matrix, x[None, :], y[:, None])
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        # NaN and what lies behind the camera fail every comparison below.
        w += matrix[3, 2] * disparity_px
        reciprocal = 1 / w
        q = (q + matrix[2, 2] * disparity_px) * reciprocal
        seen = (w > 0) & (q > 0) & (disparity_px > 0) & np.isfinite(q)
        to_half, to_centre = np.float32(1 / _STEP), np.float32(0.5 / _STEP + 0.5)
        column = (u + matrix[0, 2] * disparity_px) * reciprocal * to_half + to_centre
        row = (v + matrix[1, 2] * disparity_px) * reciprocal * to_half + to_centre
    column, row, q = column[seen], row[seen], q[seen]
    index = np.clip(row, 0, rows + 1).astype(np.int32) * np.int32(padded)
    index += np.clip(column, 0, columns + 1).astype(np.int32)
    # The nearest surface is written last, and the last write stays. A sort by 16 bits is a radix
    # sort, many times faster than one of floats; closer than 1 / 65535 of the range is one depth.
    if q.size:
        order = np.argsort((q * (65535 / q.max())).astype(np.uint16), kind="stable")
        q, index = q[order], index[order]
    nearest = np.zeros((rows + 3) * padded, np.float32)
    corners = np.array([0, 1, padded, padded + 1], np.int32)
    nearest[index[:, None] + corners] = q[:, None]
    return np.ascontiguousarray(nearest.reshape(rows + 3, padded)[1 : rows + 1, 1 : columns + 1])


def _enlarged(half: NDArray[Value], view: View) -> NDArray[Value]:
    """Repeat every pixel, to the size of the view."""
    return half.repeat(_STEP, axis=0).repeat(_STEP, axis=1)[: view.height, : view.width]


def _look_up_all(source: _Map, guess: Plane, view: View) -> _Found:
    """Refine the inverse depth of every pixel of a view.

    Band by band: the intermediate planes stay in the processor's cache, which halves the time.
    """
    x = np.arange(view.width, dtype=np.float32)[None, :]
    y = np.arange(view.height, dtype=np.float32)[:, None]
    rows = max(1, _CHUNK // view.width)
    bands = [slice(top, top + rows) for top in range(0, view.height, rows)]
    return _joined([_look_up(source, x, y[band], guess[band]) for band in bands])


def _look_up_some(source: _Map, guess: Plane, pixels: Mask) -> _Found:
    """Refine the inverse depth of the chosen pixels; the planes are [N]."""
    y, x = (index.astype(np.float32)[:, None] for index in np.nonzero(pixels))
    values = guess[pixels][:, None]
    chunks = [slice(start, start + _CHUNK) for start in range(0, len(x), _CHUNK)]
    found = _joined([_look_up(source, x[chunk], y[chunk], values[chunk]) for chunk in chunks])
    sigma = None if found.sigma is None else found.sigma[:, 0]
    return _Found(found.inverse_depth[:, 0], found.covered[:, 0], sigma)


def _joined(parts: list[_Found]) -> _Found:
    sigmas = [part.sigma for part in parts if part.sigma is not None]
    return _Found(
        np.concatenate([part.inverse_depth for part in parts]),
        np.concatenate([part.covered for part in parts]),
        np.concatenate(sigmas) if sigmas else None,
    )


def _look_up(source: _Map, x: Plane, y: Plane, guess: Plane) -> _Found:
    """Read the map where pixels (x, y) of the view came from if their inverse depth is ``guess``.

    Where the map has no value there, the guess stays.
    """
    import cv2  # here: loading it takes longer than the rest of the client

    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        u, v, d, w = _products(source.uvd_from_uvq, x, y)
        column = source.uvd_from_uvq[:, 2]
        w += column[3] * guess
        np.reciprocal(w, out=w)
        u += column[0] * guess
        u *= w
        v += column[1] * guess
        v *= w
        disparity_px = source.result.disparity_px
        read = cv2.remap(disparity_px, u, v, cv2.INTER_NEAREST, borderValue=(0.0,))
        smooth = cv2.remap(disparity_px, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        one_surface = np.abs(smooth - read) < _EDGE_PX  # false for NaN
        np.copyto(read, smooth, where=one_surface & (read > 0))
        # The guess itself goes forward to w * (x, y, guess, 1), so that only the change of the
        # disparity has to be added.
        d += column[2] * guess
        d *= w
        np.subtract(read, d, out=d)
        forward = source.uvq_from_uvd[:, 2]
        q = w * guess
        q += forward[2] * d
        w += forward[3] * d
        q /= w
        useful = (read > 0) & (q > 0) & (w > 0) & (guess > 0)
        refined = np.where(useful, q, guess)
        # Beside an edge the map can have another surface there, which belongs to another pixel
        # of the view: (x, y) + (forward - forward[3] * (x, y)) * d / w.
        d /= w
        across, along = (forward[0] - forward[3] * x) * d, (forward[1] - forward[3] * y) * d
        covered = useful & (np.abs(across) < _MISS_PX) & (np.abs(along) < _MISS_PX)
        if source.result.sigma_px is None:
            return _Found(refined, covered, None)
        sigma_px = cv2.remap(source.result.sigma_px, u, v, cv2.INTER_NEAREST, borderValue=(0.0,))
        own = sigma_px * (forward[2] - q * forward[3]) / w  # the change of q with the disparity
        moved = q * q * np.float32(MOTION_M_S * source.age_s)
        return _Found(refined, covered, np.sqrt(own * own + moved * moved))


def _filled_far(nearest: Plane) -> Plane:
    """Give each hole the farther one of the next seen pixels to the left and right in its row.

    Rows without any seen pixel stay 0.
    """
    seen = nearest > 0
    columns = np.arange(nearest.shape[1], dtype=np.int32)
    last = np.int32(nearest.shape[1] - 1)
    to_left = np.maximum.accumulate(np.where(seen, columns, 0), axis=1)
    to_right = np.minimum.accumulate(np.where(seen, columns, last)[:, ::-1], axis=1)[:, ::-1]
    nothing = np.float32(np.inf)
    known = np.where(seen, nearest, nothing)
    left, right = (np.take_along_axis(known, index, axis=1) for index in (to_left, to_right))
    far = np.minimum(left, right)
    return np.where(np.isfinite(far), far, np.float32(0))
