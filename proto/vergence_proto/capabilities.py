"""What a server can do that servers of version 0.1 could not, by the names in its information."""

from enum import StrEnum


class Capability(StrEnum):
    """One ability of a server, in ``GetServerInfoResponse.capabilities``."""

    MAP_STEP = "map_step"
    """Maps of every second or fourth row and column, of a stream or of one frame."""
    FRAME_SCALE = "frame_scale"
    """Images of half the size."""
    COARSE_MAPS = "coarse_maps"
    """Fixed point down to 1/4 px."""
    DELTA_DEFLATE = "delta_deflate"
    """A compression of maps that browsers have."""
    RECEIVED_TIMES = "received_times"
    """Maps and pongs say when the request had arrived."""
    PACED_CREDIT = "paced_credit"
    """More frames unanswered for a client that paces them."""
    RECTIFYING_ROTATION = "rectifying_rotation"
    """The opening's answer has the rotation of the rectified left camera."""
    REQUEST_RECORDS = "request_records"
    """Over HTTP, all messages of a call in one request."""
