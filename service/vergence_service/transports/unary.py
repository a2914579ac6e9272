"""The unary methods of DepthService (one request, one answer), on any transport."""

from importlib.metadata import version

from vergence_proto import codec
from vergence_proto.instruction_set import instruction_set
from vergence_proto.model_io import ModelCard
from vergence_proto.v1 import depth_pb2 as pb
from vergence_service.streams.engine import DepthEngine


class UnaryMethods:
    """Translates each request to a call of the engine. Raises DepthError."""

    def __init__(
        self, engine: DepthEngine, *, computed_by: str, provider: str, max_frame_bytes: int
    ) -> None:
        self._engine = engine
        self._computed_by = computed_by
        self._provider = provider
        self._max_frame_bytes = max_frame_bytes

    async def server_info(self, request: pb.GetServerInfoRequest) -> pb.GetServerInfoResponse:
        return pb.GetServerInfoResponse(
            version=version("vergence"),
            model=model_info(self._engine.card),
            provider=self._provider,
            streams_open=len(self._engine.streams),
            streams_max=self._engine.streams.capacity,
            max_message_bytes=self._max_frame_bytes,
            max_pixels=self._engine.max_pixels,
            engine=self._computed_by,
            instruction_set=instruction_set(),
        )

    async def stream(self, request: pb.GetStreamRequest) -> pb.GetStreamResponse:
        stream = self._engine.streams.get(request.stream_id)
        return pb.GetStreamResponse(
            stream_id=stream.stream_id,
            attached=stream.attachment is not None,
            rig=codec.rectified_rig_to_proto(stream.rectifier.rig),
            frames_stepped=stream.frames_stepped,
            frames_dropped=stream.frames_dropped,
            frames_failed=stream.frames_failed,
            last_frame_id=stream.last_frame_id,
            step_count=stream.state.step_count if stream.state else 0,
            idle_s=self._engine.streams.idle_s(stream),
            state_bytes=stream.state.nbytes if stream.state else 0,
        )

    async def reset(self, request: pb.ResetStreamRequest) -> pb.ResetStreamResponse:
        await self._engine.reset(request.stream_id)
        return pb.ResetStreamResponse()

    async def close(self, request: pb.CloseStreamRequest) -> pb.CloseStreamResponse:
        await self._engine.close(request.stream_id)
        return pb.CloseStreamResponse()


def model_info(card: ModelCard) -> pb.ModelInfo:
    return pb.ModelInfo(
        name=card.name,
        weights_sha256=card.weights_sha256,
        iterations=sorted(card.graphs),
        max_disparity_px=card.max_disparity_px,
    )
