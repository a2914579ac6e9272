"""How a rectified pair is shown to the model, whose search covers a fixed range of offsets."""

import math
from dataclasses import dataclass, replace
from typing import Self

import cv2
import numpy as np

from vergence_proto.geometry import RectifiedRig
from vergence_proto.types import Image, Plane


@dataclass(frozen=True, slots=True)
class SearchReach:
    """The range of disparities that streams are searched for."""

    max_disparity_px: int  # the model searches offsets from 0 to this
    min_width_share: float  # the least range of a large image, as a share of its width; 0: none

    def reduction(self, width: int) -> int:
        """Return the factor by which images of this width are reduced for the search."""
        return max(1, math.ceil(self.min_width_share * width / self.max_disparity_px))


@dataclass(frozen=True, slots=True)
class SearchWindow:
    """The images of one rig as the model sees them, and its answer in the rig's own pixels.

    The model searches from offset 0. So one image is moved to the right by whole pixels to make
    that disparity 0: cameras whose principal points differ lose no range. If it is the left one,
    the images grow wider, because nothing of it may be lost. And where the range would be a small
    share of a wide image, the image is reduced by a whole factor.
    """

    rig: RectifiedRig  # of the images that the model sees
    left_shift_px: int
    right_shift_px: int
    reduction: int
    max_disparity_px: float  # in the rig's own pixels

    @classmethod
    def of(cls, rig: RectifiedRig, reach: SearchReach) -> Self:
        zero_px = math.floor(rig.offset_of_zero_disparity_px)
        # Farther apart than their width, images share no point but one beyond the range.
        left_shift = min(max(0, -zero_px), rig.width)
        right_shift = max(0, zero_px)
        reduction = reach.reduction(rig.width)
        shifted = replace(
            rig,
            width=rig.width + left_shift,
            cx_left=rig.cx_left + left_shift,
            cx_right=rig.cx_right + right_shift,
        )
        beyond_zero_px = shifted.offset_of_zero_disparity_px
        return cls(
            _reduced(shifted, reduction),
            left_shift,
            right_shift,
            reduction,
            reach.max_disparity_px * reduction - beyond_zero_px,
        )

    def images(self, left: Image, right: Image) -> tuple[Image, Image]:
        """The images as the model sees them, from uint8 [H, W, C] of the rig's size."""
        width = left.shape[1] + self.left_shift_px
        left = _moved(left, self.left_shift_px, width)
        right = _moved(right, self.right_shift_px, width)
        return self._smaller(left), self._smaller(right)

    def disparity_px(self, offset_px: Plane, height: int, width: int) -> Plane:
        """Disparity [H, W] of the rig from the model's offset; NaN where it is out of range."""
        disparity_px = self._enlarged(
            offset_px - np.float32(self.rig.offset_of_zero_disparity_px), height, width
        )
        disparity_px[(disparity_px <= 0) | (disparity_px > self.max_disparity_px)] = np.nan
        return disparity_px

    def left_of(self, image: Image, height: int, width: int) -> Image:
        """What the left camera of the rig saw, of the image that the model sees, reduced as it."""
        first = self.left_shift_px // self.reduction
        return image[: -(-height // self.reduction), first : first - (-width // self.reduction)]

    def sigma_px(self, sigma_px: Plane, height: int, width: int) -> Plane:
        """Sigma [H, W] in the rig's pixels."""
        return self._enlarged(sigma_px, height, width)

    def _smaller(self, image: Image) -> Image:
        if self.reduction == 1:
            return image
        around = ((0, -image.shape[0] % self.reduction), (0, -image.shape[1] % self.reduction))
        whole = np.pad(image, (*around, (0, 0)), mode="edge")
        size = (self.rig.width, self.rig.height)
        return np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_AREA), np.uint8)

    def _enlarged(self, plane: Plane, height: int, width: int) -> Plane:
        columns = slice(self.left_shift_px, self.left_shift_px + width)
        if self.reduction == 1:
            return plane[:, columns]
        size = (self.rig.width * self.reduction, self.rig.height * self.reduction)
        larger = cv2.resize(plane, size, interpolation=cv2.INTER_LINEAR)
        return np.asarray(larger[:height, columns] * np.float32(self.reduction), np.float32)


def _moved(image: Image, shift_px: int, width: int) -> Image:
    """The image moved to the right, of that width; its edges repeat."""
    if shift_px == 0 and width == image.shape[1]:
        return image
    columns = np.arange(width) - shift_px
    return image[:, columns.clip(0, image.shape[1] - 1)]


def _reduced(rig: RectifiedRig, factor: int) -> RectifiedRig:
    """The rig of images whose pixels are blocks of ``factor`` x ``factor``."""

    def centre(c: float) -> float:
        return (c + 0.5) / factor - 0.5

    return RectifiedRig(
        width=-(-rig.width // factor),
        height=-(-rig.height // factor),
        fx=rig.fx / factor,
        fy=rig.fy / factor,
        cx_left=centre(rig.cx_left),
        cx_right=centre(rig.cx_right),
        cy=centre(rig.cy),
        baseline_m=rig.baseline_m,
    )
