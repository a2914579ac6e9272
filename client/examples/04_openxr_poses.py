"""Poses of an OpenXR headset: quaternions x y z w, axes x right, y up, z back.

Run: ``python client/examples/04_openxr_poses.py --server grpc://127.0.0.1:50051``
"""

# ruff: noqa: T201  an example prints

import argparse
import asyncio
from importlib.resources import files
from itertools import islice

import numpy as np

import vergence
from vergence import Axes, Pose, PoseSample
from vergence_proto.datasets import open_source


async def main() -> None:
    """Step five frames with poses as XrSpaceLocation states them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--server", default=vergence.DEFAULT_SERVER)
    server = parser.parse_args().server

    room = open_source(f"vergence:{files('vergence') / 'sample' / 'room'}")
    async with (
        vergence.DepthClient(server) as client,
        client.open_session(
            room.rig, axes=Axes.OPENXR, delivery=vergence.Delivery.EVERY
        ) as session,
    ):
        for each in islice(room, 5):
            frame = each.frame
            assert frame.pose is not None
            # The sample has OpenCV poses; a headset's runtime returns these numbers directly.
            location = Axes.OPENXR.from_opencv(frame.pose.world_from_left)
            orientation_xyzw, position_m = location.orientation_xyzw, location.translation_m

            sample = PoseSample(
                Pose.from_xyzw(orientation_xyzw, position_m),
                orientation_valid=True,  # XR_SPACE_LOCATION_ORIENTATION_VALID_BIT
                position_valid=True,  # XR_SPACE_LOCATION_POSITION_VALID_BIT
                tracked=True,
            )
            result = await session.step(
                frame.left, frame.right, sample, capture_ns=frame.capture_ns
            )
            assert result.world_from_left is not None
            position = np.round(result.world_from_left.translation_m, 3).tolist()
            print(f"frame {result.frame_id}: camera at {position} m, {result.origin.value}")


if __name__ == "__main__":
    asyncio.run(main())
