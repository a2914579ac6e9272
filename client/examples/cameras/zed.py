"""Depth of a ZED camera: its rectified pair, and the poses of its own tracking.

Needs the ZED SDK with its Python API, ``pyzed``. Not run on a device.
Run: ``python client/examples/cameras/zed.py --server grpc://127.0.0.1:50051``
"""

# ruff: noqa: T201  an example prints

import argparse
import sys

import numpy as np
import pyzed.sl as sl

import vergence


def rig_of(zed: sl.Camera) -> vergence.RectifiedRig:
    """The rectified pair, in metres."""
    seen = zed.get_camera_information().camera_configuration
    k, right = seen.calibration_parameters.left_cam, seen.calibration_parameters.right_cam
    baseline_m = seen.calibration_parameters.get_camera_baseline()
    size = seen.resolution
    return vergence.RectifiedRig(
        size.width, size.height, k.fx, k.fy, k.cx, right.cx, k.cy, baseline_m
    )


def image(zed: sl.Camera, view: sl.VIEW) -> np.ndarray:
    """One view as RGB; the camera gives BGRA."""
    found = sl.Mat()
    zed.retrieve_image(found, view)
    return np.ascontiguousarray(found.get_data()[..., 2::-1])


parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--server", default=vergence.DEFAULT_SERVER)
parser.add_argument("--frames", type=int, default=300)
arguments = parser.parse_args()

zed, settings, pose = sl.Camera(), sl.InitParameters(), sl.Pose()
settings.camera_resolution, settings.depth_mode = sl.RESOLUTION.HD720, sl.DEPTH_MODE.NONE
settings.coordinate_units = sl.UNIT.METER
settings.coordinate_system = sl.COORDINATE_SYSTEM.IMAGE  # x right, y down, z forward, as OpenCV's
if zed.open(settings) != sl.ERROR_CODE.SUCCESS:
    sys.exit("no ZED camera can be opened")
zed.enable_positional_tracking(sl.PositionalTrackingParameters())
with (
    vergence.BlockingClient(arguments.server) as client,
    client.open_session(rig_of(zed)) as session,
):
    for _ in range(arguments.frames):
        if zed.grab() != sl.ERROR_CODE.SUCCESS:
            continue
        tracking = zed.get_position(pose, sl.REFERENCE_FRAME.WORLD)
        known = tracking == sl.POSITIONAL_TRACKING_STATE.OK
        world_from_left = vergence.Pose.from_matrix(pose.pose_data().m) if known else None
        result = session.step(image(zed, sl.VIEW.LEFT), image(zed, sl.VIEW.RIGHT), world_from_left)
        depth_m = np.nanmedian(result.depth_m)
        print(f"frame {result.frame_id}: {result.origin.value}, median {depth_m:.2f} m")
zed.close()
