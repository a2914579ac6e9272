"""The way from a rectified map back to the image as the camera took it."""

import numpy as np
from numpy.typing import NDArray

from vergence_proto.geometry import Pose, RectifiedRig
from vergence_proto.types import Distortion, Intrinsics


def image_pixels(
    camera: Intrinsics, rig: RectifiedRig, left_from_rectified: Pose
) -> NDArray[np.float32]:
    """Return the position in the camera's image of each pixel of the rectified left image.

    float32 [H, W, 2], pixels (x, y), for OpenCV's lens models.
    """
    import cv2  # takes a tenth of a second to import, and few programs need this

    projection = np.array([[rig.fx, 0, rig.cx_left], [0, rig.fy, rig.cy], [0, 0, 1]])
    make_maps = (
        cv2.fisheye.initUndistortRectifyMap
        if camera.distortion is Distortion.KANNALA_BRANDT
        else cv2.initUndistortRectifyMap
    )
    columns, rows = make_maps(
        camera.matrix,
        np.array(camera.coefficients or (0.0,) * 4),
        left_from_rectified.rotation.T,
        projection,
        (rig.width, rig.height),
        cv2.CV_32FC1,
    )
    return np.stack((columns, rows), axis=-1)
