"""One StreamDepth call over Zenoh: the keys of one stream instead of a connection."""

import logging
from collections.abc import AsyncIterator

import zenoh
from google.protobuf.message import Message
from google.rpc import status_pb2

from vergence_proto.codec import ReceivedFrame, Request
from vergence_proto.v1 import depth_pb2 as pb
from vergence_proto.zenoh.inbox import Inbox, InboxFull
from vergence_proto.zenoh.keys import OPEN, StreamKeys, place_of, query_key
from vergence_proto.zenoh.session import Declaration, ZenohSession
from vergence_service.access.principals import Principal
from vergence_service.transports.open_calls import OpenCalls
from vergence_service.transports.stream_call import ClientLost
from vergence_service.transports.zenoh.errors import status_of

log = logging.getLogger(__name__)


class ZenohCall:
    """Translates between the keys of one stream and a DepthCall. An open query creates it.

    Where the network is full, live frames and their answers are dropped instead of delayed. The
    call finds lost frames by the gaps in their ids and answers them as dropped. Every pong lists
    the frames that still wait for an answer. So no credit is lost.
    """

    def __init__(
        self,
        peer: ZenohSession,
        query: zenoh.Query,
        opening: pb.OpenStream,
        *,
        namespace: str,
        attachment_id: str,
        caller: Principal,
        calls: OpenCalls,
    ) -> None:
        self._peer = peer
        self._query: zenoh.Query | None = query  # None after its answer
        self._opening = opening
        self._namespace = namespace
        self._attachment_id = attachment_id
        self._calls = calls
        self._caller = caller
        self._live = opening.delivery != pb.DELIVERY_EVERY
        self._paces = opening.paces and self._live
        # Zenoh reports no addresses: all clients without a token count as one address.
        client = "" if caller.proven else "zenoh"
        self._call = calls.make(self._requests(), self._write, client=client, caller=caller)
        self._inbox = Inbox(
            attachment_id,
            bulky=pb.Frame,
            max_bulky=1 if self._live else calls.limits.credit,
            drop_oldest=self._live,
        )
        self._subscription: Declaration | None = None
        self._unanswered: set[int] = set()  # frame ids
        self._last_frame_id: int | None = None

    async def run(self) -> None:
        """Serve the call to its end, and report the end to the client."""
        end: Message = pb.End()
        try:
            await self._calls.run(self._call)
        except ClientLost as lost:
            log.info("a call over Zenoh counts as lost: %s", lost)
            return  # to a client that wakes up, the server does not answer any more
        except Exception as error:
            end = status_of(error)
        finally:
            if self._subscription is not None:
                await self._peer.undeclare(self._subscription)
        if self._query is None:
            await self._peer.put(self._keys.status, end, attachment_id=self._attachment_id)
        elif isinstance(end, status_pb2.Status):
            await self._peer.refuse(self._query, end)

    async def _requests(self) -> AsyncIterator[Request]:
        yield self._opening
        while True:
            try:
                message = await self._inbox.take()
            except InboxFull as error:
                self._call.end(error)
                return
            match message:
                case ReceivedFrame():
                    await self._note(message.frame_id)
                    yield message
                case pb.Ping() | pb.Reset() | pb.End():
                    yield message

    async def _note(self, frame_id: int) -> None:
        last = self._last_frame_id
        if last is not None:
            # No more frames of a client wait for an answer, so no more can be missing.
            limits = self._calls.limits
            most = limits.paced_credit if self._paces else limits.credit
            oldest = max(last + 1, frame_id - most)
            await self._call.report_lost(range(oldest, frame_id))
        self._last_frame_id = frame_id
        self._unanswered.add(frame_id)

    async def _write(self, response: pb.StreamDepthResponse) -> None:
        match response.WhichOneof("message"):
            case "opened":
                await self._accept(response.opened)
            case "disparity":
                self._unanswered.discard(response.disparity.frame_id)
                await self._send(self._keys.disparity, response.disparity)
            case "frame_error":
                self._unanswered.discard(response.frame_error.frame_id)
                await self._send(self._keys.status, response)
            case "frames_dropped":
                self._unanswered.difference_update(response.frames_dropped.frame_ids)
                await self._send(self._keys.status, response)
            case "pong":
                response.pong.unanswered_frame_ids.extend(sorted(self._unanswered))
                await self._send(self._keys.status, response)
            case _:
                await self._send(self._keys.status, response)

    async def _accept(self, opened: pb.StreamOpened) -> None:
        """Answer the query. Frames may follow at once, so subscribe to them first."""
        place = place_of(self._caller.name, self._attachment_id)
        self._keys = StreamKeys(self._namespace, place, opened.stream_id)
        self._subscription = await self._peer.subscribe(self._keys.frames, self._inbox.put)
        query, self._query = self._query, None
        assert query is not None
        key = query_key(self._namespace, self._caller.name, self._peer.id, OPEN)
        await self._peer.reply(query, key, opened)

    async def _send(self, key: str, message: Message) -> None:
        await self._peer.put(key, message, attachment_id=self._attachment_id, may_drop=self._live)
