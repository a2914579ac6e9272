"""Depth of a Luxonis OAK camera: its two grey cameras as they are; the server rectifies.

Needs ``pip install depthai``. Written against the types of DepthAI 3.12; not run on a device.
Run: ``python client/examples/cameras/oak.py --server grpc://127.0.0.1:50051``
"""

# ruff: noqa: T201  an example prints

import argparse

import depthai as dai
import numpy as np

import vergence

SIZE = (640, 400)
LEFT, RIGHT = dai.CameraBoardSocket.CAM_B, dai.CameraBoardSocket.CAM_C


def camera(
    calibration: dai.CalibrationHandler, socket: dai.CameraBoardSocket
) -> vergence.Intrinsics:
    """The lens of one camera, for images of SIZE."""
    k = calibration.getCameraIntrinsics(socket, *SIZE)
    return vergence.Intrinsics(
        *SIZE,
        *(k[0][0], k[1][1], k[0][2], k[1][2]),
        vergence.Distortion.BROWN_CONRADY,
        tuple(calibration.getDistortionCoefficients(socket)),
    )


def rig_of(calibration: dai.CalibrationHandler) -> vergence.StereoRig:
    """The two cameras, in metres."""
    left_from_right = calibration.getCameraExtrinsics(RIGHT, LEFT, unit=dai.LengthUnit.METER)
    pose = vergence.Pose.from_matrix(np.array(left_from_right))
    return vergence.StereoRig(camera(calibration, LEFT), camera(calibration, RIGHT), pose)


def image(pair: dai.MessageGroup, name: str) -> np.ndarray:
    """One view, uint8 [H, W]."""
    frame = pair[name]
    assert isinstance(frame, dai.ImgFrame)
    return frame.getCvFrame()


parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--server", default=vergence.DEFAULT_SERVER)
parser.add_argument("--frames", type=int, default=300)
arguments = parser.parse_args()

with dai.Pipeline() as pipeline:
    sync = pipeline.create(dai.node.Sync)
    for name, socket in (("left", LEFT), ("right", RIGHT)):
        grey = pipeline.create(dai.node.Camera).build(socket)
        view = grey.requestOutput(SIZE, dai.ImgFrame.Type.GRAY8, enableUndistortion=False)
        view.link(sync.inputs[name])
    pairs = sync.out.createOutputQueue(maxSize=1, blocking=False)  # the newest pair, no older one
    rig = rig_of(pipeline.getDefaultDevice().readCalibration())
    pipeline.start()
    with vergence.BlockingClient(arguments.server) as client, client.open_session(rig) as session:
        for _ in range(arguments.frames):
            pair = pairs.get()
            assert isinstance(pair, dai.MessageGroup)
            result = session.step(image(pair, "left"), image(pair, "right"))
            depth_m = np.nanmedian(result.depth_m)
            print(f"frame {result.frame_id}: {result.origin.value}, median {depth_m:.2f} m")
