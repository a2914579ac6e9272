"""The Zenoh transport: a network of routers and peers with any number of servers."""

import asyncio
import math
import random
import time
from pathlib import Path

import zenoh
from google.protobuf.message import Message

from vergence.transports.base import Answer, Call, ClientClosed, ConnectionLost
from vergence.transports.zenoh_call import ServerInfos, ZenohCall
from vergence_proto.errors import DepthError, StreamExpired, UnknownStream
from vergence_proto.v1 import depth_pb2 as pb
from vergence_proto.zenoh.keys import ANY, LOCAL_PRINCIPAL, UNARY_KEYS, query_key
from vergence_proto.zenoh.session import QueryReply, ZenohSession, make_config, reason_of

_ASK_TIMEOUT_S = 1.5  # a slower server counts as absent
_OPEN_TIMEOUT_MS = 5000  # Zenoh's handshake takes three round trips
# A server that another one could replace gets this long to come back: a router that was restarted
# sees its servers again within the pause between two of their attempts.
_HOME_PATIENCE_S = 2.0
_MAX_MESSAGE_BYTES = 64 << 20  # limit on received messages, far above the largest map


class ZenohTransport:
    """The :class:`~vergence.transports.base.Transport` to the servers of one namespace.

    ``endpoint`` belongs to a router, or to a server that is one: ``tcp/127.0.0.1:7447``. ``config``
    is a Zenoh JSON5 file with TLS and access control.
    """

    def __init__(self, endpoint: str, namespace: str, config: Path | None = None) -> None:
        self._endpoint = endpoint
        self._namespace = namespace
        self._config = config
        self._peer: ZenohSession | None = None  # for unary methods
        self._closed = False
        self._turn = asyncio.Lock()
        # Who asks: the user of the configuration, or "local" if the servers know no users.
        self._principal = ""
        self._calls: dict[str, ZenohCall] = {}  # the latest call of each stream that has not ended

    async def open_call(self, stream_id: str) -> Call:
        # A session of its own: it can connect while the last one's link is dead without knowing it.
        peer = await self._opened()
        self._calls = {each.stream_id: each for each in self._calls.values() if not each.over}
        before = self._calls.get(stream_id)

        async def find(resume_token: bytes) -> ServerInfos:
            question = pb.GetStreamRequest(stream_id=stream_id, resume_token=resume_token)
            infos = await self._servers_for(peer, question, before if resume_token else None)
            if before is not None and before.server_id in infos:  # it may still have the stream
                infos = {before.server_id: infos[before.server_id], **infos}
            return infos

        call = ZenohCall(
            peer, self._namespace, stream_id, find, before, principal=lambda: self._principal
        )
        if self._closed:
            await call.close()
            raise ClientClosed
        self._calls[stream_id] = call
        return call

    async def ask(self, method: str, request: Message, answer: type[Answer]) -> Answer:
        """Return the first answer, if several servers have one."""
        async with self._turn:
            if self._peer is None:
                self._peer = await self._opened()
        return next(iter((await self._ask_all(self._peer, method, request, answer)).values()))

    async def close(self) -> None:
        self._closed = True
        for call in self._calls.values():
            await call.close()
        async with self._turn:
            peer, self._peer = self._peer, None
            if peer is not None:
                await peer.close()

    async def _opened(self) -> ZenohSession:
        if self._closed:
            raise ClientClosed
        config = make_config(
            self._config,
            max_message_bytes=_MAX_MESSAGE_BYTES,
            mode="client",
            connect__endpoints=[self._endpoint],
            connect__timeout_ms=0,  # one attempt; the session makes others
            transport__unicast__open_timeout=_OPEN_TIMEOUT_MS,
            scouting__multicast__enabled=False,  # overrides the file
        )
        peer = ZenohSession(config)
        try:
            await peer.open()
        except zenoh.ZError as error:
            raise self._lost(error) from None
        return peer

    def _lost(self, error: zenoh.ZError) -> ConnectionLost:
        return ConnectionLost(f"no connection to {self._endpoint}: {reason_of(error)}")

    async def _servers_for(
        self, peer: ZenohSession, question: pb.GetStreamRequest, before: ZenohCall | None
    ) -> ServerInfos:
        """Return the servers for a stream, best first: the one that has it, else by load.

        ``before`` is the last call of a stream to resume. Raises ConnectionLost: no server answers,
        or not yet the one of ``before``.
        """
        home = before.server_id if before else ""
        # Both at once: a server that hangs costs the whole timeout, and opening has a timeout too.
        infos, holders = await asyncio.gather(
            self._ask_all(
                peer, "GetServerInfo", pb.GetServerInfoRequest(), pb.GetServerInfoResponse
            ),
            self._holders(peer, question),
        )
        lost_for_s = time.monotonic() - (before.lost_s or 0.0) if before else math.inf
        if home not in infos and lost_for_s < _HOME_PATIENCE_S:
            raise ConnectionLost(
                f"the server of stream {question.stream_id!r} is not on the network"
            )
        known = [each for each in holders if each in infos] or [home] * (home in infos)
        ids = known or sorted(infos, key=lambda each: _load(infos[each]))
        return {each: infos[each] for each in ids}

    async def _holders(self, peer: ZenohSession, question: pb.GetStreamRequest) -> list[str]:
        """Return the id of the server that has the stream, if there is one."""
        try:
            return list(await self._ask_all(peer, "GetStream", question, pb.GetStreamResponse))
        except (UnknownStream, StreamExpired):
            return []

    async def _ask_all(
        self, peer: ZenohSession, method: str, question: Message, kind: type[Answer]
    ) -> dict[str, Answer]:
        """Return the answers by server id.

        Raises the most specific error if every server refuses; ConnectionLost: no server answers.
        """
        answers: list[QueryReply] = []
        try:
            for principal in [self._principal] if self._principal else [peer.user, LOCAL_PRINCIPAL]:
                if principal and not answers:
                    key = query_key(self._namespace, principal, ANY, UNARY_KEYS[method])
                    answers = await peer.query(key, question, timeout_s=_ASK_TIMEOUT_S)
                    self._principal = principal if answers else ""
        except zenoh.ZError as error:
            raise self._lost(error) from None
        refusals = [each.error for each in answers if each.error is not None]
        if known := [each for each in answers if each.error is None]:
            return {each.server_id: kind.FromString(each.payload) for each in known}
        if refusals:
            raise max(refusals, key=_specificity)
        raise ConnectionLost(
            f"no server answers in namespace {self._namespace!r} at {self._endpoint}"
        )


def _load(info: pb.GetServerInfoResponse) -> tuple[float, float]:
    # Equal servers are chosen at random, or all clients would choose the same one.
    return info.streams_open / max(info.streams_max, 1), random.random()


def _specificity(refusal: DepthError) -> int:
    """UnknownStream is the least specific error: another server may have had the stream."""
    return 0 if isinstance(refusal, UnknownStream) else 1
