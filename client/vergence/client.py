"""The way in: one client per server, any number of sessions on it."""

import uuid
from collections.abc import Callable
from typing import Self

from vergence.info import ServerInfo, StreamInfo
from vergence.results import SessionEvent
from vergence.session import DepthSession
from vergence.transports.addresses import connector, on_this_machine
from vergence_proto import codec
from vergence_proto.geometry import Axes, RectifiedRig
from vergence_proto.types import Delivery, ImageEncoding, OutputFormat, StereoRig, checked_stream_id
from vergence_proto.v1 import depth_pb2 as pb

DEFAULT_SERVER = "grpc://127.0.0.1:50051"


class DepthClient:
    """A connection to a server; connects when it is first needed.

    ``server`` is ``grpc://HOST:PORT``, or ``zenoh://HOST:PORT[/NAMESPACE][?config=FILE]`` with the
    place of a Zenoh router, of which a server can be one, or ``http://HOST:PORT`` where nothing
    else gets through; anything else is a ValueError. Every method raises NotReady (ConnectionLost)
    where the server cannot be reached, and otherwise the class of :mod:`vergence_proto.errors` that
    the server raised. Use it inside ``async with``, from one event loop.
    """

    def __init__(self, server: str = DEFAULT_SERVER) -> None:
        self._connect = connector(server)
        self._on_this_machine = on_this_machine(server)

    async def __aenter__(self) -> Self:
        self._transport = self._connect()
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        await self._transport.close()

    def open_session(
        self,
        rig: StereoRig | RectifiedRig,
        *,
        axes: Axes = Axes.OPENCV,
        delivery: Delivery = Delivery.NEWEST,
        output: OutputFormat | None = None,
        iterations: int = 0,
        cold_iterations: int = 0,
        weights_sha256: str = "",
        encoding: ImageEncoding = ImageEncoding.RAW,
        jpeg_quality: int = 90,
        stream_id: str | None = None,
        resume_token: bytes = b"",
        on_event: Callable[[SessionEvent], None] | None = None,
    ) -> DepthSession:
        """A session, to be used inside ``async with``, which opens the stream and ends it.

        Parameters
        ----------
        rig
            The cameras as they are; the server rectifies if they are not.
        axes
            The convention of all poses of this session, in and out.
        delivery
            NEWEST: live, a newer frame displaces one that waits. EVERY: lossless, step() only.
        output
            What results carry and how exactly; default: disparity to 1/64 px, compressed (which
            loses nothing) unless the server is on this machine, where it would only cost time.
        iterations, cold_iterations
            Refinements of a warm step and of a cold start; 0: the server's defaults.
        weights_sha256
            The weights that results must come from
            (:attr:`vergence.ModelInfo.weights_sha256`), where they
            must be comparable; default: whatever the server runs, and the same after a resume.
        encoding
            How images travel: RAW is exact and costs bandwidth, PNG is exact and costs time.
        stream_id
            1 to 128 characters of [A-Za-z0-9._-]; default: a random one.
        resume_token
            Takes over the open stream of this ``stream_id``; its old session gets Superseded.
        on_event
            Called in the event loop with what happens to the session; must not block.

        Raises BadShape: the stream id. Entering raises BadCalibration, ModelChanged, StreamExists,
        Quota, StreamLimit, StateMemory, Draining, NotReady.
        """
        opening = pb.OpenStream(
            stream_id=checked_stream_id(uuid.uuid4().hex if stream_id is None else stream_id),
            resume_token=resume_token,
            rig=codec.rig_to_proto(
                StereoRig.from_rectified(rig) if isinstance(rig, RectifiedRig) else rig
            ),
            axes=codec.axes_to_proto(axes),
            delivery=codec.delivery_to_proto(delivery),
            output=codec.output_format_to_proto(
                output or OutputFormat(compressed=not self._on_this_machine)
            ),
            iterations=iterations,
            cold_iterations=cold_iterations,
            weights_sha256=weights_sha256,
        )
        return DepthSession(
            self._transport,
            opening,
            encoding=encoding,
            jpeg_quality=jpeg_quality,
            on_event=on_event,
        )

    async def server_info(self) -> ServerInfo:
        request = pb.GetServerInfoRequest()
        response = await self._transport.ask("GetServerInfo", request, pb.GetServerInfoResponse)
        return ServerInfo.from_proto(response)

    async def stream_info(self, stream_id: str) -> StreamInfo:
        """Raises UnknownStream, StreamExpired."""
        request = pb.GetStreamRequest(stream_id=stream_id)
        response = await self._transport.ask("GetStream", request, pb.GetStreamResponse)
        return StreamInfo.from_proto(response)

    async def close_stream(self, stream_id: str) -> None:
        """End a stream, whoever holds it, and free its state. Raises UnknownStream."""
        request = pb.CloseStreamRequest(stream_id=stream_id)
        await self._transport.ask("CloseStream", request, pb.CloseStreamResponse)
