"""Depth of a single pair, in one call."""

from vergence.blocking import BlockingClient
from vergence.image_format import CameraImage
from vergence.results import DepthResult
from vergence.transports.addresses import DEFAULT_SERVER
from vergence_proto.geometry import RectifiedRig
from vergence_proto.types import Delivery, StereoRig


def depth(
    left: CameraImage,
    right: CameraImage,
    rig: StereoRig | RectifiedRig,
    *,
    server: str = DEFAULT_SERVER,
    iterations: int = 0,
) -> DepthResult:
    """Compute the depth of one pair, in a stream of its own.

    Parameters
    ----------
    left, right
        uint8 [H, W] grey, [H, W, 3] RGB, [H, W, 4] RGBA or [H * 3/2, W] NV12, of the rig's size;
        or the bytes of a JPEG or PNG file, which travel as they are.
    rig
        The cameras as they are; the server rectifies the images if the rig is not rectified.
    server
        The address of the server, as in :class:`vergence.DepthClient`.
    iterations
        Refinement iterations; 0: the server's default for a cold start.

    Raises
    ------
    ValueError
        ``server`` is no address of a server.
    BadImage
        An image has another type or shape, or is a damaged file.
    BadShape
        The images do not have the rig's size, or ``iterations`` is out of range.
    BadCalibration
        The server cannot use the rig.
    FrameTooLarge
        The frame has more bytes or pixels than the server accepts.
    StreamLimit, StateMemory, Quota
        The server has no room for another stream.
    ModelFailed, NonFinite
        The model failed on this pair.
    Draining, NotReady
        The server is shutting down, or is not ready yet.
    ConnectionLost
        The server cannot be reached.
    """
    with (
        BlockingClient(server) as client,
        client.open_session(rig, delivery=Delivery.EVERY, cold_iterations=iterations) as session,
    ):
        return session.step(left, right)
