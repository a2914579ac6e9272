"""One attachment to a stream over Zenoh: a StreamDepth call made of key expressions."""

import secrets
import time
from collections import deque
from collections.abc import Awaitable, Callable

import zenoh
from google.protobuf.message import Message
from google.rpc import status_pb2

from vergence.transports.base import ConnectionLost
from vergence.transports.zenoh_losses import Unanswered
from vergence_proto import codec
from vergence_proto.errors import (
    DepthError,
    Draining,
    FrameTooLarge,
    ModelFailed,
    NotReady,
    StateMemory,
    StreamLimit,
)
from vergence_proto.v1 import depth_pb2 as pb
from vergence_proto.zenoh.inbox import Inbox, InboxFull
from vergence_proto.zenoh.keys import ANY, OPEN, StreamKeys, place_of, query_key, server_key
from vergence_proto.zenoh.session import Declaration, ZenohSession, reason_of

ServerInfos = dict[str, pb.GetServerInfoResponse]  # by server id, best first

_OPEN_TIMEOUT_S = 3.0
# Above the server's credit; beyond this number the oldest map is discarded.
_WAITING_MAPS = 16
# These refusals mean that the server has no room; another one may have.
_NO_ROOM = (StreamLimit, StateMemory, Draining, NotReady)


class ZenohCall:
    """A :class:`~vergence.transports.base.Call`.

    Frames lost on the network are detected and reported as ``FramesDropped``, so that every frame
    is answered, as over gRPC.
    """

    def __init__(
        self,
        peer: ZenohSession,
        namespace: str,
        stream_id: str,
        find_servers: Callable[[bytes], Awaitable[ServerInfos]],
        before: "ZenohCall | None",
        *,
        principal: Callable[[], str],  # known when the servers are found
    ) -> None:
        self._principal = principal
        self.stream_id: str = stream_id
        # The server on which the stream is open, or was at the last call of the stream.
        self.server_id: str = before.server_id if before else ""
        self.over: bool = False  # True: the server ended the call; it was not lost
        self._peer = peer
        self._namespace = namespace
        self._find_servers = find_servers
        self._attachment_id = secrets.token_hex(16)
        self._inbox = Inbox(
            self._attachment_id, bulky=pb.DisparityMap, max_bulky=_WAITING_MAPS, drop_oldest=True
        )
        self._declared: list[Declaration] = []
        self._ready: deque[pb.StreamDepthResponse] = deque()
        # From this time on there was no connection; None: there is one.
        self.lost_s: float | None = before.lost_s if before else None
        self._closed = False
        self._live = True
        self._max_frame_bytes = 0
        self._unanswered = Unanswered()

    async def send(self, request: bytes) -> None:
        message = pb.StreamDepthRequest.FromString(request)
        try:
            match message.WhichOneof("message"):
                case "open":
                    await self._open(message.open)
                case "frame":
                    await self._send_frame(message.frame)
                case "ping":
                    await self._send_ping(message.ping)
                case "reset":
                    await self._put(message.reset)
                case "end":
                    await self._put(message.end)
        except zenoh.ZError as error:
            self.lose(reason_of(error))
        except DepthError as error:
            self._inbox.end(error)

    async def receive(self) -> pb.StreamDepthResponse | None:
        while not self._ready:
            try:
                message = await self._inbox.take()
            except InboxFull as error:
                raise ConnectionLost(f"the server sent more than was asked for: {error}") from None
            match message:
                case pb.DisparityMap():
                    self._take(pb.StreamDepthResponse(disparity=message))
                case pb.StreamDepthResponse():
                    self._take(message)
                case pb.End():
                    self.over = True
                    return None
                case status_pb2.Status():
                    self.over = True
                    raise codec.error_from_status(message) or ModelFailed(message.message)
        return self._ready.popleft()

    def _take(self, response: pb.StreamDepthResponse) -> None:
        if lost := self._unanswered.answered(response):
            dropped = pb.FramesDropped(frame_ids=lost)
            self._ready.append(pb.StreamDepthResponse(frames_dropped=dropped))
        self._ready.append(response)

    async def close(self) -> None:
        self.lose("the call was closed")
        if not self._closed:
            self._closed = True
            await self._peer.close()

    def lose(self, why: str) -> None:
        """End the call as lost; the session resumes it."""
        self.lost_s = self.lost_s or time.monotonic()
        self._inbox.end(ConnectionLost(why))

    async def _open(self, opening: pb.OpenStream) -> None:
        self._live = opening.delivery != pb.DELIVERY_EVERY
        servers = await self._find_servers(opening.resume_token)
        place = place_of(self._principal(), self._attachment_id)
        self._keys = StreamKeys(self._namespace, place, self.stream_id)
        peer, declared = self._peer, self._declared
        declared.append(await peer.subscribe(self._keys.disparity, self._inbox.put))
        declared.append(await peer.subscribe(self._keys.status, self._inbox.put))
        declared.append(
            await peer.watch_liveliness(server_key(self._namespace, ANY), self._server_died)
        )
        declared.append(await peer.declare_liveliness(self._keys.client(self._attachment_id)))
        refusal: DepthError = ConnectionLost("no server answers")
        for server_id, info in servers.items():
            key = query_key(self._namespace, self._principal(), server_id, OPEN)
            answers = await peer.query(
                key, opening, timeout_s=_OPEN_TIMEOUT_S, attachment_id=self._attachment_id
            )
            if not answers:
                # It may still open the stream, so no other server is asked.
                raise ConnectionLost(f"server {server_id} did not answer")
            error = answers[0].error
            if error is None:
                self._max_frame_bytes = info.max_message_bytes
                self.server_id, self.lost_s = server_id, None
                opened = pb.StreamOpened.FromString(answers[0].payload)
                self._inbox.put_local(pb.StreamDepthResponse(opened=opened))
                return
            refusal = error
            if not isinstance(error, _NO_ROOM):
                break
        raise refusal

    def _server_died(self, key: str) -> None:
        if key == server_key(self._namespace, self.server_id):
            self.lose(f"server {self.server_id} is gone, or the way to it")

    async def _send_frame(self, frame: pb.Frame) -> None:
        # Far above its limit, a server's Zenoh link drops a message silently.
        if (size := frame.ByteSize()) > self._max_frame_bytes:
            error = FrameTooLarge(
                f"expected a frame of at most {self._max_frame_bytes} bytes, got {size}; send "
                "JPEG, or start the server with a larger limits.max_frame_mib"
            )
            refusal = codec.error_to_frame_error(frame.frame_id, error)
            self._inbox.put_local(pb.StreamDepthResponse(frame_error=refusal))
            return
        self._unanswered.sent(frame.frame_id)
        await self._put(frame, may_drop=self._live)

    async def _send_ping(self, ping: pb.Ping) -> None:
        self._unanswered.pinged(ping.client_ns)
        await self._put(ping, may_drop=self._live)

    async def _put(self, message: Message, *, may_drop: bool = False) -> None:
        await self._peer.put(
            self._keys.frames, message, attachment_id=self._attachment_id, may_drop=may_drop
        )
