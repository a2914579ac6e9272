"""Depth as another camera sees it: a result moved to a display's pose, field of view and time.

A result is as old as its way over the network, and the head has turned since. Its points are still
where they were: moved into the display's view, the map is as good as a new one wherever the camera
has looked (headsets do the same with colour and call it reprojection or time warp).

The method: forward-project the map at half size to learn which surface each pixel of the view sees;
then look up where on the map that pixel came from, and read the disparity there, which removes the
rounding and the fat edges of the first pass. See :mod:`vergence.map_projection`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray

from vergence.depth_formats import d16, webxr
from vergence.map_projection import EDGE_PX, STEP, Found, Mask, Projection, repeated
from vergence.results import DepthResult
from vergence_proto.errors import BadCalibration, BadPose
from vergence_proto.geometry import Pose, RectifiedRig
from vergence_proto.types import Plane

Fill = Literal["far", "none"]

# The speed at which things other than the camera are taken to move towards it or away from it, in
# metres a second: hands and people in a room, averaged over the picture.
MOTION_M_S = 0.2

_MAX_SIDE = 16384

_NEIGHBOURS = np.ones((3, 3), np.uint8)


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
    maps = [_into_view(each, world_from_view, view, at_ns) for each in (result, *keyframes)]
    # A map of which every second pixel was sent has no more detail than the half size.
    grid = STEP if all(each.raw and each.raw.step >= STEP for each in (result, *keyframes)) else 1
    seen = _seen_on_grid(maps, view, grid)
    if fill == "far":
        _fill_far(seen.inverse_depth)
    if grid > 1:
        seen = _enlarged(seen, maps[0].edge, view)

    depth_m, covered, sigma = seen  # each step is made in place: memory that is new is slow
    known = depth_m > 0 if fill == "far" else covered
    depth_m.reshape(-1)[np.flatnonzero(~known)] = np.nan
    np.reciprocal(depth_m, out=depth_m)
    if sigma is not None:  # the error of 1 / q is that of q by q squared; what is filled is unknown
        sigma *= depth_m
        sigma *= depth_m
        unseen = np.flatnonzero(~covered)
        sigma.reshape(-1)[unseen] = depth_m.reshape(-1)[unseen]
    return DepthView(view, world_from_view, depth_m, covered, sigma, maps[0].age_s, result.frame_id)


def _into_view(result: DepthResult, world_from_view: Pose, view: View, at_ns: int) -> Projection:
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
    age_s = max(0.0, (at_ns - result.capture_ns) * 1e-9)
    xyq_from_uvd = uvw_from_xyz @ view_from_left.matrix @ _xyzw_from_uvd(result.rig)
    return Projection(
        result.disparity_px,
        result.sigma_px,
        xyq_from_uvd.astype(np.float32),
        np.linalg.inv(xyq_from_uvd).astype(np.float32),
        np.float32(EDGE_PX / (result.rig.fx * result.rig.baseline_m)),
        age_s,
        MOTION_M_S * age_s,
    )


def _xyzw_from_uvd(rig: RectifiedRig) -> NDArray[np.float64]:
    """Q for a disparity that is zero at infinity, as in ``disparity_px``."""
    matrix = rig.xyzw_from_uvd
    matrix[3, 3] = 0
    return matrix


def _seen_on_grid(maps: Sequence[Projection], view: View, grid: int) -> Found:
    """See every pixel of a view, or every second one, in the first map that covers it."""
    rows, columns = -(-view.height // STEP), -(-view.width // STEP)
    size = (view.height, view.width) if grid == 1 else (rows, columns)
    x, y = (np.arange(length, dtype=np.float32) * grid + (grid - 1) / 2 for length in size[::-1])
    newest, *keyframes = maps
    guess = _on_grid(newest.splat(rows, columns), size)
    seen = newest.look_up(x[None, :], y[:, None], guess)
    for source in keyframes:
        open_to_it = ~seen.covered
        guess = _on_grid(source.splat(rows, columns, wanted=_halved(open_to_it, grid)), size)
        pixels = np.flatnonzero((guess > 0) & open_to_it)
        if not pixels.size:
            continue
        row, column = np.divmod(pixels, size[1])
        listed = guess.reshape(-1)[pixels, None]
        found = source.look_up(x[column, None], y[row, None], listed)
        seen.inverse_depth.reshape(-1)[pixels] = found.inverse_depth[:, 0]
        seen.covered.reshape(-1)[pixels] = found.covered[:, 0]
        if seen.sigma is not None:  # a keyframe without sigma says nothing of its errors
            errors = found.inverse_depth if found.sigma is None else found.sigma
            seen.sigma.reshape(-1)[pixels] = errors[:, 0]
    return seen


def _on_grid(half: Plane, size: tuple[int, int]) -> Plane:
    """Give every pixel of a grid the value of its pixel of the half size."""
    if half.shape == size:
        return half
    return np.ascontiguousarray(repeated(half)[: size[0], : size[1]])


def _halved(full: Mask, grid: int) -> Mask:
    """Return the pixels of the half size of which any pixel of the grid is true."""
    if grid != 1:
        return full
    height, width = full.shape
    even = np.zeros((height + height % STEP, width + width % STEP), np.bool_)
    even[:height, :width] = full
    rows = even[::STEP] | even[1::STEP]
    return np.asarray(rows[:, ::STEP] | rows[:, 1::STEP])


def _fill_far(inverse_depth: Plane) -> None:
    """Give each hole the farther one of the next seen pixels to the left and right in its row.

    Rows without any seen pixel stay 0.
    """
    width = inverse_depth.shape[1]
    flat = inverse_depth.reshape(-1)
    holes = np.flatnonzero(flat == 0)
    if not holes.size:
        return
    # A run of holes begins where the pixel before is none, or is in another row.
    begins = np.flatnonzero((np.diff(holes, prepend=-2) != 1) | (holes % width == 0))
    first, last = holes[begins], holes[np.append(begins[1:], holes.size) - 1]
    far = np.full(first.size, np.float32(np.inf))
    for neighbour, in_row in ((first - 1, first % width > 0), (last + 1, last % width < width - 1)):
        np.minimum(far, flat.take(neighbour, mode="clip"), out=far, where=in_row)
    far[far == np.inf] = 0
    flat[holes] = np.repeat(far, last - first + 1)


def _enlarged(half: Found, edge: np.float32, view: View) -> Found:
    """Enlarge to the view's size: linearly within a surface, where inverse depth is linear."""
    import cv2  # here: loading it takes longer than the rest of the client

    inverse_depth, covered, sigma = half
    wide = repeated(inverse_depth)
    linear = cv2.resize(inverse_depth, wide.shape[::-1], interpolation=cv2.INTER_LINEAR)
    lowest, highest = cv2.erode(inverse_depth, _NEIGHBOURS), cv2.dilate(inverse_depth, _NEIGHBOURS)
    surface = (highest - lowest < edge) & (lowest > 0)
    # What was seen is not mixed with what was filled.
    surface &= cv2.morphologyEx(covered.view(np.uint8), cv2.MORPH_GRADIENT, _NEIGHBOURS) == 0
    cv2.copyTo(linear, repeated(np.asarray(surface)).view(np.uint8), wide)
    height, width = view.height, view.width
    return Found(
        np.ascontiguousarray(wide[:height, :width]),
        np.ascontiguousarray(repeated(covered)[:height, :width]),
        None if sigma is None else np.ascontiguousarray(repeated(sigma)[:height, :width]),
    )
