"""Points of a frame, in the camera or the world, and their PLY file."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vergence_proto.codec.images import decode_image
from vergence_proto.job_results.frame_file import JobFrame

_VERTEX = np.dtype([("xyz_m", "<f4", 3), ("rgb", "u1", 3)])


def points_of(
    frame: JobFrame, *, min_confidence: int = 0
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return the points that a frame has a depth for.

    Returns
    -------
    xyz_m
        Float32 [N, 3], metres, OpenCV axes: in the world if the frame has a pose, otherwise in the
        rectified left camera.
    rgb
        Uint8 [N, 3] of the left image; white if the job did not keep it.
    """
    disparity = frame.disparity
    if disparity is None:
        return np.empty((0, 3), np.float32), np.empty((0, 3), np.uint8)
    rig, depth_m = disparity.rig, disparity.depth_m
    kept = np.isfinite(depth_m)
    if min_confidence and disparity.confidence is not None:
        kept &= disparity.confidence >= min_confidence
    v, u = np.nonzero(kept)
    z = depth_m[v, u].astype(np.float64)
    xyz = np.stack([(u - rig.cx_left) / rig.fx * z, (v - rig.cy) / rig.fy * z, z], axis=-1)
    if frame.record.world_from_left is not None:
        xyz = frame.record.world_from_left.apply(xyz)
    rgb = np.full((len(v), 3), 255, np.uint8)
    if frame.left is not None:
        rgb = decode_image(frame.left)[v, u]
    return xyz.astype(np.float32), rgb


def encode_ply(frame: JobFrame) -> bytes:
    """Encode the points of a frame as a binary PLY with colours."""
    xyz_m, rgb = points_of(frame)
    vertices: NDArray[Any] = np.empty(len(xyz_m), _VERTEX)
    vertices["xyz_m"], vertices["rgb"] = xyz_m, rgb
    where = "camera" if frame.record.world_from_left is None else "world"
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"comment frame {frame.record.index}, {where} coordinates, OpenCV axes, metres\n"
        f"element vertex {len(vertices)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
    )
    return header.encode() + vertices.tobytes()
