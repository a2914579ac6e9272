"""Frames as a camera would hand them to a session, by their numbers."""

from tests.support.frames import make_frame
from vergence import DepthResult, DepthSession, NotSent, OutputFormat, PlaneEncoding

EXACT = OutputFormat(encoding=PlaneEncoding.FLOAT32)


async def step(session: DepthSession, frame_id: int, brightness: int = 64) -> DepthResult:
    frame = make_frame(frame_id, brightness=brightness)
    return await session.step(frame.left, frame.right, frame.pose, capture_ns=frame.capture_ns)


def submit(session: DepthSession, frame_id: int, brightness: int = 64) -> int | NotSent:
    frame = make_frame(frame_id, brightness=brightness)
    return session.submit(frame.left, frame.right, frame.pose, capture_ns=frame.capture_ns)
