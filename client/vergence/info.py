"""What a server says about itself and its streams."""

from dataclasses import dataclass
from typing import Self

from vergence_proto.v1 import depth_pb2 as pb


@dataclass(frozen=True, slots=True)
class ModelInfo:
    name: str
    weights_sha256: str
    iterations: tuple[int, ...]  # the counts a step can run
    max_disparity_px: int

    @classmethod
    def from_proto(cls, message: pb.ModelInfo) -> Self:
        iterations = tuple(message.iterations)
        return cls(message.name, message.weights_sha256, iterations, message.max_disparity_px)


@dataclass(frozen=True, slots=True)
class ServerInfo:
    version: str
    model: ModelInfo
    provider: str  # what the model runs on, as onnxruntime names it
    engine: str  # what computes it, with its version; empty: an older server
    instruction_set: str  # the best of the server's CPU for int8; empty: an older server
    streams_open: int
    streams_max: int
    max_message_bytes: int
    max_pixels: int  # of one image

    @classmethod
    def from_proto(cls, message: pb.GetServerInfoResponse) -> Self:
        return cls(
            version=message.version,
            model=ModelInfo.from_proto(message.model),
            provider=message.provider,
            engine=message.engine,
            instruction_set=message.instruction_set,
            streams_open=message.streams_open,
            streams_max=message.streams_max,
            max_message_bytes=message.max_message_bytes,
            max_pixels=message.max_pixels,
        )


@dataclass(frozen=True, slots=True)
class StreamInfo:
    """One stream as the server sees it."""

    stream_id: str
    attached: bool  # a connection holds it
    frames_stepped: int
    frames_dropped: int
    frames_failed: int
    last_frame_id: int
    step_count: int  # steps since the state was new; 0: the next one is a cold start
    idle_s: float
    state_bytes: int

    @classmethod
    def from_proto(cls, message: pb.GetStreamResponse) -> Self:
        return cls(
            stream_id=message.stream_id,
            attached=message.attached,
            frames_stepped=message.frames_stepped,
            frames_dropped=message.frames_dropped,
            frames_failed=message.frames_failed,
            last_frame_id=message.last_frame_id,
            step_count=message.step_count,
            idle_s=message.idle_s,
            state_bytes=message.state_bytes,
        )
