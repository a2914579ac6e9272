"""The unary methods of DepthService (one request, one answer), on any transport."""

import hmac
from importlib.metadata import version

from vergence_proto import codec
from vergence_proto.capabilities import Capability
from vergence_proto.errors import UnknownStream
from vergence_proto.instruction_set import instruction_set
from vergence_proto.model_io import ModelCard
from vergence_proto.v1 import depth_pb2 as pb
from vergence_service.access.principals import Principal, Role
from vergence_service.streams.engine import DepthEngine
from vergence_service.streams.stream import Stream


class UnaryMethods:
    """Translates each request to a call of the engine. Raises DepthError.

    A stream of another principal is unknown. A caller that has shown no credential must know the
    stream's resume token, since all such callers share a name. An administrator writes
    PRINCIPAL/STREAM to mean the stream of another.
    """

    def __init__(
        self, engine: DepthEngine, *, computed_by: str, provider: str, max_frame_bytes: int
    ) -> None:
        self._engine = engine
        self._computed_by = computed_by
        self._provider = provider
        self._max_frame_bytes = max_frame_bytes

    async def server_info(
        self, request: pb.GetServerInfoRequest, caller: Principal
    ) -> pb.GetServerInfoResponse:
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
            capabilities=list(Capability),
        )

    async def stream(self, request: pb.GetStreamRequest, caller: Principal) -> pb.GetStreamResponse:
        stream = self._stream_of(request, caller)
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

    async def reset(
        self, request: pb.ResetStreamRequest, caller: Principal
    ) -> pb.ResetStreamResponse:
        stream = self._stream_of(request, caller)
        await self._engine.reset(stream.stream_id, owner=stream.owner.name)
        return pb.ResetStreamResponse()

    async def close(
        self, request: pb.CloseStreamRequest, caller: Principal
    ) -> pb.CloseStreamResponse:
        stream = self._stream_of(request, caller)
        await self._engine.close(stream.stream_id, owner=stream.owner.name)
        return pb.CloseStreamResponse()

    def _stream_of(
        self,
        request: pb.GetStreamRequest | pb.ResetStreamRequest | pb.CloseStreamRequest,
        caller: Principal,
    ) -> Stream:
        owner, _, stream_id = request.stream_id.rpartition("/")
        if owner and caller.role is not Role.ADMIN:
            raise UnknownStream(f"no open stream {request.stream_id!r}")
        stream = self._engine.streams.get(stream_id, owner=owner or caller.name)
        if caller.proven or hmac.compare_digest(request.resume_token, stream.resume_token):
            return stream
        raise UnknownStream(
            f"no open stream {stream_id!r} for this caller: without a credential, the request must "
            "have the stream's resume token"
        )


def model_info(card: ModelCard) -> pb.ModelInfo:
    return pb.ModelInfo(
        name=card.name,
        weights_sha256=card.weights_sha256,
        iterations=sorted(card.graphs),
        max_disparity_px=card.max_disparity_px,
        recurrent=card.recurrent,
    )
