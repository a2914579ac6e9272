"""Depth of a RealSense D400 camera: its infrared pair, which the camera rectifies.

Needs ``pip install pyrealsense2``. Written against pyrealsense2 2.59; not run on a device.
Run: ``python client/examples/cameras/realsense.py --server grpc://127.0.0.1:50051``
"""

# ruff: noqa: T201  an example prints

import argparse

import numpy as np
import pyrealsense2 as rs

import vergence

SIZE, FPS = (640, 480), 30


def rig_of(profile: rs.pipeline_profile) -> vergence.RectifiedRig:
    """The rectified pair, in metres."""
    left, right = (
        profile.get_stream(rs.stream.infrared, index).as_video_stream_profile() for index in (1, 2)
    )
    k, other = left.get_intrinsics(), right.get_intrinsics()
    baseline_m = abs(left.get_extrinsics_to(right).translation[0])
    return vergence.RectifiedRig(k.width, k.height, k.fx, k.fy, k.ppx, other.ppx, k.ppy, baseline_m)


parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--server", default=vergence.DEFAULT_SERVER)
parser.add_argument("--frames", type=int, default=300)
arguments = parser.parse_args()

pipeline, config = rs.pipeline(), rs.config()
for index in (1, 2):
    config.enable_stream(rs.stream.infrared, index, *SIZE, rs.format.y8, FPS)
profile = pipeline.start(config)
# The projector's dots are the same in every frame: they would look like things that do not move.
profile.get_device().first_depth_sensor().set_option(rs.option.emitter_enabled, 0)
try:
    with (
        vergence.BlockingClient(arguments.server) as client,
        client.open_session(rig_of(profile)) as session,
    ):
        for _ in range(arguments.frames):
            frames = pipeline.wait_for_frames()  # the newest set; older ones are dropped
            left, right = (
                np.asanyarray(frames.get_infrared_frame(index).get_data()) for index in (1, 2)
            )
            result = session.step(left, right)
            depth_m = np.nanmedian(result.depth_m)
            print(f"frame {result.frame_id}: {result.origin.value}, median {depth_m:.2f} m")
finally:
    pipeline.stop()
