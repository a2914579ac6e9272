"""Rigs, frames and their messages, small and exact."""

import numpy as np

from vergence_proto import codec
from vergence_proto.geometry import Pose, RectifiedRig
from vergence_proto.types import ImageEncoding, PoseSample, StereoFrame, StereoRig
from vergence_proto.v1 import depth_pb2 as pb
from vergence_service.streams.search_window import SearchReach

RIG = RectifiedRig(
    width=64, height=48, fx=60.0, fy=60.0, cx_left=31.5, cx_right=31.5, cy=23.5, baseline_m=0.1
)
REACH = SearchReach(max_disparity_px=64, min_width_share=0.0)
FRAME_NS = 33_000_000  # between two frames


def make_frame(frame_id: int, *, brightness: int = 64, rig: RectifiedRig = RIG) -> StereoFrame:
    """One frame of a camera that moves sideways by a centimetre a frame past a textured wall."""
    rng = np.random.default_rng(brightness)
    left = rng.integers(0, 32, (rig.height, rig.width, 3), np.uint8)
    left[0, 0] = brightness
    return StereoFrame(
        frame_id=frame_id,
        capture_ns=frame_id * FRAME_NS,
        left=left,
        right=np.roll(left, -4, axis=1),
        pose=PoseSample(Pose(np.eye(3), np.array([0.01 * frame_id, 0.0, 0.0]))),
    )


def frame_message(frame: StereoFrame, *, max_age_s: float | None = None) -> pb.StreamDepthRequest:
    request = codec.frame_to_request(frame, encoding=ImageEncoding.RAW, max_age_s=max_age_s)
    return pb.StreamDepthRequest.FromString(request)


def open_message(
    stream_id: str = "",
    *,
    rig: StereoRig | None = None,
    resume_token: bytes = b"",
    every: bool = True,
    axes: pb.Axes = pb.AXES_OPENCV,
    sigma: bool = False,
    opening_id: bytes = b"",
) -> pb.StreamDepthRequest:
    return pb.StreamDepthRequest(
        open=pb.OpenStream(
            stream_id=stream_id,
            resume_token=resume_token,
            opening_id=opening_id,
            rig=codec.rig_to_proto(rig or StereoRig.from_rectified(RIG)),
            axes=axes,
            delivery=pb.DELIVERY_EVERY if every else pb.DELIVERY_NEWEST,
            output=pb.OutputFormat(
                encoding=pb.PLANE_ENCODING_FLOAT32, sigma=sigma, confidence=sigma
            ),
        )
    )
