"""Rectify the images of any rig, with maps that are made once per stream."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from vergence_proto.errors import BadCalibration
from vergence_proto.geometry import Matrix, Pose, RectifiedRig
from vergence_proto.types import Distortion, Image, Intrinsics, Plane, StereoRig
from vergence_service.streams.search_window import SearchReach, SearchWindow

_OUT_OF_MEMORY = -4  # cv::Error::StsNoMem
_WIDEST_VIEW_DEG = 110.0
_KEPT_SHARE = 0.8  # of the least focal length: OpenCV's choice is kept down to this
_LOOKS_AHEAD = 0.2  # cosine of the angle between an original and the rectified axis
_ALONG_ROWS = 0.5  # share of the baseline that must lie along the rows: OpenCV turns it there


@dataclass(frozen=True, slots=True, eq=False)
class _Maps:
    """The position of each rectified pixel in the original image, in OpenCV's fixed-point form."""

    whole: NDArray[np.int16]  # [H, W, 2]
    fraction: NDArray[np.uint16]  # [H, W]

    def remap(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        remapped = cv2.remap(image, self.whole, self.fraction, cv2.INTER_LINEAR)
        return np.asarray(remapped, np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class _Cameras:
    """The rectified cameras of a rig, and how the original ones see them."""

    rig: RectifiedRig
    rotations: list[Matrix]  # [3, 3], rectified_from_left and rectified_from_right
    projections: list[Matrix]  # [3, 3], the intrinsics of the rectified cameras


def check_rig(rig: StereoRig, reach: SearchReach) -> None:
    """Refuse a rig that :meth:`Rectifier.of` cannot rectify.

    Raises BadCalibration, as :meth:`Rectifier.of` does.
    """
    rectified = rig.as_rectified()
    if rectified is None:
        with _opencv_errors():
            cameras = _rectified_cameras(rig)
            _seen(_left_maps(rig, cameras))
        rectified = cameras.rig
    SearchWindow.of(rectified, reach)


@dataclass(frozen=True, slots=True, eq=False)
class Rectifier:
    """Makes the model's images from those of one rig."""

    rig: RectifiedRig  # of the rectified images, in which results are given
    window: SearchWindow
    left_from_rectified: Pose  # a rotation: both left cameras have one centre
    maps: tuple[_Maps, _Maps] | None = None  # None: the rig is already rectified
    seen: NDArray[np.bool_] | None = None  # [H, W]: the left camera saw this rectified pixel

    @classmethod
    def of(cls, rig: StereoRig, reach: SearchReach) -> Self:
        """Make a rectifier, with maps if the rig needs them, for a model of that reach.

        Raises BadCalibration if the right camera is not on the right, or if the cameras have no
        view in common.
        """
        rectified = rig.as_rectified()
        if rectified is None:
            with _opencv_errors():
                return cls._from_cameras(rig, reach)
        return cls(rectified, SearchWindow.of(rectified, reach), Pose.identity())

    @classmethod
    def _from_cameras(cls, rig: StereoRig, reach: SearchReach) -> Self:
        cameras = _rectified_cameras(rig)
        left_maps = _left_maps(rig, cameras)
        seen = _seen(left_maps)
        right_maps = _maps(rig.right, cameras.rotations[1], cameras.projections[1])
        left_from_rectified = Pose(cameras.rotations[0].T.copy(), np.zeros(3))
        window = SearchWindow.of(cameras.rig, reach)
        return cls(cameras.rig, window, left_from_rectified, (left_maps, right_maps), seen)

    def rectify(self, left: Image, right: Image) -> tuple[Image, Image]:
        """The pair as the model sees it, from images as the cameras took them."""
        with _opencv_errors():
            if self.maps is not None:
                left_maps, right_maps = self.maps
                left, right = left_maps.remap(left), right_maps.remap(right)
            return self.window.images(left, right)

    def rectified_left(self, left: Image) -> Image:
        """The left image at the size of ``rig``, from the image as the camera took it."""
        with _opencv_errors():
            return left if self.maps is None else self.maps[0].remap(left)

    def disparity_px(self, offset_px: Plane) -> Plane:
        """Disparity [H, W] of ``rig`` from the model's offset.

        It is NaN where it is not positive or beyond the range, or where the camera saw nothing.
        """
        disparity_px = self.window.disparity_px(offset_px, self.rig.height, self.rig.width)
        if self.seen is not None:
            disparity_px[~self.seen] = np.nan
        return disparity_px

    def sigma_px(self, sigma_px: Plane) -> Plane:
        """Sigma [H, W] of ``rig`` from the model's."""
        return self.window.sigma_px(sigma_px, self.rig.height, self.rig.width)


@contextmanager
def _opencv_errors() -> Iterator[None]:
    """Raise BadCalibration for what OpenCV refuses, and MemoryError if it has no memory."""
    try:
        yield
    except cv2.error as error:
        if error.code == _OUT_OF_MEMORY:
            raise MemoryError(error.err) from None
        raise BadCalibration(
            f"the rig has no rectification: {error.err}; check its intrinsics"
        ) from None


def _rectified_cameras(rig: StereoRig) -> _Cameras:
    fisheye = {camera.distortion is Distortion.KANNALA_BRANDT for camera in (rig.left, rig.right)}
    if len(fisheye) > 1:
        raise BadCalibration("expected both cameras to be fisheye or neither, got one of each")
    projections, rotations = (_fisheye if fisheye.pop() else _pinhole)(rig)
    if not np.isfinite(rotations).all():
        raise BadCalibration("the rig has no rectification; check distortion and left_from_right")
    towards_left_m = rotations[1] @ rig.left_from_right.inverse().translation_m
    baseline_m = -towards_left_m[0]
    if not baseline_m > _ALONG_ROWS * np.linalg.norm(towards_left_m):
        raise BadCalibration(
            "expected the right camera to the right of the left one (left_from_right with a "
            f"translation mostly along +x), got {rig.left_from_right.translation_m.tolist()}"
        )
    left_k, right_k = _useful(rig, rotations, [projection[:, :3] for projection in projections])
    rectified = RectifiedRig(
        rig.left.width,
        rig.left.height,
        float(left_k[0, 0]),
        float(left_k[1, 1]),
        float(left_k[0, 2]),
        float(right_k[0, 2]),
        float(left_k[1, 2]),
        float(baseline_m),
    )
    return _Cameras(rectified, rotations, [left_k, right_k])


def _useful(rig: StereoRig, rotations: list[Matrix], intrinsics: list[Matrix]) -> list[Matrix]:
    """Return the rectified intrinsics, or better ones if OpenCV's show too wide a view.

    OpenCV fits the whole of a lens into the rectified image. A plane has room for less than 180
    degrees, and the more it shows, the fewer pixels are left for what is ahead. So a rectified
    image shows at most the angle below, or what it shows at the focal length of the original.
    """
    width, height = rig.left.width, rig.left.height
    ahead_px = min(rig.left.fx, rig.left.fy, rig.right.fx, rig.right.fy)
    least_px = min(ahead_px, width / 2 / np.tan(np.radians(_WIDEST_VIEW_DEG / 2)))
    if np.isfinite(intrinsics).all() and all(
        _KEPT_SHARE * least_px <= min(each[0, 0], each[1, 1]) for each in intrinsics
    ):
        return intrinsics
    axes = [rotation[:, 2] for rotation in rotations]  # where the original cameras look
    if min(axis[2] for axis in axes) < _LOOKS_AHEAD:
        raise BadCalibration(
            "expected two cameras that look into one direction, across the baseline; "
            "check left_from_right"
        )
    x, y, _ = np.mean([axis / axis[2] for axis in axes], axis=0)
    centre = (width - 1) / 2 - least_px * x, (height - 1) / 2 - least_px * y
    matrix = np.array([[least_px, 0, centre[0]], [0, least_px, centre[1]], [0, 0, 1]])
    return [matrix, matrix.copy()]


def _left_maps(rig: StereoRig, cameras: _Cameras) -> _Maps:
    return _maps(rig.left, cameras.rotations[0], cameras.projections[0])


def _seen(left_maps: _Maps) -> NDArray[np.bool_]:
    """Return where the left camera sees the rectified image, bool [H, W]."""
    white = np.full(left_maps.fraction.shape, 255, np.uint8)
    seen = np.asarray(left_maps.remap(white) == 255)
    if not seen.any():
        raise BadCalibration("no pixel of the rectified left image is seen by the camera")
    return seen


def _pinhole(rig: StereoRig) -> tuple[list[Matrix], list[Matrix]]:
    right_from_left = rig.left_from_right.inverse()
    left_rotation, right_rotation, left_projection, right_projection, *_ = cv2.stereoRectify(
        rig.left.matrix,
        _coefficients(rig.left),
        rig.right.matrix,
        _coefficients(rig.right),
        (rig.left.width, rig.left.height),
        right_from_left.rotation,
        right_from_left.translation_m[:, None],
        flags=cv2.CALIB_ZERO_DISPARITY,
    )
    return _float64(left_projection, right_projection), _float64(left_rotation, right_rotation)


def _fisheye(rig: StereoRig) -> tuple[list[Matrix], list[Matrix]]:
    right_from_left = rig.left_from_right.inverse()
    left_rotation, right_rotation, left_projection, right_projection, _ = cv2.fisheye.stereoRectify(
        rig.left.matrix,
        _coefficients(rig.left),
        rig.right.matrix,
        _coefficients(rig.right),
        (rig.left.width, rig.left.height),
        right_from_left.rotation,
        right_from_left.translation_m[:, None],
        flags=cv2.CALIB_ZERO_DISPARITY,
    )
    return _float64(left_projection, right_projection), _float64(left_rotation, right_rotation)


def _maps(camera: Intrinsics, rotation: Matrix, rectified: Matrix) -> _Maps:
    fisheye = camera.distortion is Distortion.KANNALA_BRANDT
    make = cv2.fisheye.initUndistortRectifyMap if fisheye else cv2.initUndistortRectifyMap
    size = (camera.width, camera.height)
    whole, fraction = make(
        camera.matrix, _coefficients(camera), rotation, rectified, size, cv2.CV_16SC2
    )
    return _Maps(np.asarray(whole, np.int16), np.asarray(fraction, np.uint16))


def _coefficients(camera: Intrinsics) -> Matrix:
    return np.array(camera.coefficients or (0.0, 0.0, 0.0, 0.0), np.float64)[:, None]


def _float64(*matrices: object) -> list[Matrix]:
    return [np.asarray(matrix, np.float64) for matrix in matrices]
