"""Conversion of the server's messages about itself to the values in :mod:`vergence.info`."""

from vergence.info import ModelInfo, ServerInfo, StreamInfo
from vergence_proto.v1 import depth_pb2 as pb


def model_info_from_proto(message: pb.ModelInfo) -> ModelInfo:
    """Convert the description of a model."""
    iterations = tuple(message.iterations)
    return ModelInfo(
        name=message.name,
        weights_sha256=message.weights_sha256,
        iterations=iterations,
        max_disparity_px=message.max_disparity_px,
        recurrent=message.recurrent or not message.HasField("recurrent"),  # absent: older server
    )


def server_info_from_proto(message: pb.GetServerInfoResponse) -> ServerInfo:
    """Convert the description of a server."""
    return ServerInfo(
        version=message.version,
        model=model_info_from_proto(message.model),
        provider=message.provider,
        engine=message.engine,
        instruction_set=message.instruction_set,
        streams_open=message.streams_open,
        streams_max=message.streams_max,
        max_message_bytes=message.max_message_bytes,
        max_pixels=message.max_pixels,
        capabilities=frozenset(message.capabilities),
    )


def stream_info_from_proto(message: pb.GetStreamResponse) -> StreamInfo:
    """Convert the description of a stream."""
    return StreamInfo(
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
