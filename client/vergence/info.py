"""A server's description of itself, its model and its streams."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ModelInfo:
    """The network and weights that a server runs."""

    name: str
    """The name of the model, such as ``lite``."""
    weights_sha256: str
    """SHA-256 of the weights, 64 hexadecimal digits; equal digests give comparable results."""
    iterations: tuple[int, ...]
    """The iteration counts that a step can run."""
    max_disparity_px: int
    """The largest disparity that the model searches, in pixels of images up to 1280 px wide.

    A result states its own range as ``max_disparity_px``."""
    recurrent: bool = True
    """The model remembers past frames. False: every frame is a cold start, and poses are unused."""


@dataclass(frozen=True, slots=True)
class ServerInfo:
    """A server, its model and its limits."""

    version: str
    """The version of the server."""
    model: ModelInfo
    """The model that new streams use."""
    provider: str
    """The device that runs the model, by its onnxruntime name."""
    engine: str
    """The runtime and its version; empty from an older server."""
    instruction_set: str
    """The best int8 instruction set of the server's CPU; empty from an older server."""
    streams_open: int
    """Streams that are open now."""
    streams_max: int
    """Streams that may be open at once."""
    max_message_bytes: int
    """The largest message in bytes that the server accepts."""
    max_pixels: int
    """The largest number of pixels of one image."""
    capabilities: frozenset[str] = frozenset()
    """What the server can do that one of version 0.1 could not; see
    :class:`vergence_proto.capabilities.Capability`."""


@dataclass(frozen=True, slots=True)
class StreamInfo:
    """One stream as the server sees it."""

    stream_id: str
    """The id of the stream."""
    attached: bool
    """A connection holds the stream now."""
    frames_stepped: int
    """Frames that the model processed."""
    frames_dropped: int
    """Frames that the server dropped."""
    frames_failed: int
    """Frames that ended in an error."""
    last_frame_id: int
    """The id of the last frame that the server accepted; 0: none."""
    step_count: int
    """Steps since the state was new; 0: the next step is a cold start."""
    idle_s: float
    """Seconds since the last frame."""
    state_bytes: int
    """Memory of the stream's state in bytes."""
