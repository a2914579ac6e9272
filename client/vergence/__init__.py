"""Live stereo depth over the network: the client.

Depth of one pair::

    import vergence

    depth_m = vergence.depth(left, right, rig).depth_m

A moving camera, live: one task submits frames, another reads results::

    async def film(session):
        async for left, right, world_from_left in camera:
            session.submit(left, right, world_from_left)

    async with vergence.DepthClient("grpc://127.0.0.1:50051") as client:
        async with client.open_session(rig) as session:
            filming = asyncio.create_task(film(session))
            async for result in session:
                print(result.depth_m.shape, result.age_s)

Everything public is in ``__all__``; the modules behind it may change. The errors that a server
raises are those of :mod:`vergence_proto.errors`; :class:`NotOpen` and :class:`ConnectionLost` are
the client's own.
"""

from vergence.blocking import BlockingClient, BlockingSession, depth
from vergence.client import DEFAULT_SERVER, DepthClient
from vergence.errors import NotOpen
from vergence.info import ModelInfo, ServerInfo, StreamInfo
from vergence.reprojection import DepthView, View, reproject
from vergence.results import DepthResult, Drops, EventKind, SessionEvent
from vergence.session import DepthSession
from vergence.transports.base import ConnectionLost
from vergence_proto.errors import (
    BadCalibration,
    BadImage,
    BadPose,
    BadSequence,
    BadShape,
    DepthError,
    Draining,
    ErrorCode,
    FrameOutOfOrder,
    FrameStale,
    FrameTooLarge,
    ModelChanged,
    ModelFailed,
    NonFinite,
    NotReady,
    QueueFull,
    Quota,
    SequenceNotDone,
    StateMemory,
    StreamExists,
    StreamExpired,
    StreamLimit,
    Superseded,
    UnknownSequence,
    UnknownStream,
    UploadTooLarge,
)
from vergence_proto.geometry import Axes, Pose, RectifiedRig
from vergence_proto.types import (
    Delivery,
    DisparityMap,
    Distortion,
    ImageEncoding,
    Intrinsics,
    Origin,
    OutputFormat,
    PlaneEncoding,
    PoseSample,
    StereoRig,
    Timings,
)

__all__ = [
    "DEFAULT_SERVER",
    "Axes",
    "BadCalibration",
    "BadImage",
    "BadPose",
    "BadSequence",
    "BadShape",
    "BlockingClient",
    "BlockingSession",
    "ConnectionLost",
    "Delivery",
    "DepthClient",
    "DepthError",
    "DepthResult",
    "DepthSession",
    "DepthView",
    "DisparityMap",
    "Distortion",
    "Draining",
    "Drops",
    "ErrorCode",
    "EventKind",
    "FrameOutOfOrder",
    "FrameStale",
    "FrameTooLarge",
    "ImageEncoding",
    "Intrinsics",
    "ModelChanged",
    "ModelFailed",
    "ModelInfo",
    "NonFinite",
    "NotOpen",
    "NotReady",
    "Origin",
    "OutputFormat",
    "PlaneEncoding",
    "Pose",
    "PoseSample",
    "QueueFull",
    "Quota",
    "RectifiedRig",
    "SequenceNotDone",
    "ServerInfo",
    "SessionEvent",
    "StateMemory",
    "StereoRig",
    "StreamExists",
    "StreamExpired",
    "StreamInfo",
    "StreamLimit",
    "Superseded",
    "Timings",
    "UnknownSequence",
    "UnknownStream",
    "UploadTooLarge",
    "View",
    "depth",
    "reproject",
]
