"""Zenoh: keys on a network of routers and peers, where any number of servers may be."""

import asyncio
import random
from pathlib import Path

import zenoh
from google.protobuf.message import Message

from vergence.transports.base import Answer, Call, ConnectionLost
from vergence.transports.zenoh_call import ServerInfos, ZenohCall
from vergence_proto.errors import DepthError, StreamExpired, UnknownStream
from vergence_proto.v1 import depth_pb2 as pb
from vergence_proto.zenoh.keys import ANY, UNARY_KEYS, query_key
from vergence_proto.zenoh.session import ZenohSession, make_config, reason_of

_ASK_TIMEOUT_S = 1.5  # a server that has not answered by then is as good as none
_CONNECT_TIMEOUT_MS = 1000
_MAX_MESSAGE_BYTES = 64 << 20  # of what comes: far above the largest map


class ZenohTransport:
    """The :class:`~vergence.transports.base.Transport` to the servers of one namespace.

    ``endpoint`` is that of a router, or of a server that is one: ``tcp/127.0.0.1:7447``. ``config``
    is a Zenoh JSON5 file, for what TLS and access control need.
    """

    def __init__(self, endpoint: str, namespace: str, config: Path | None = None) -> None:
        self._endpoint = endpoint
        self._namespace = namespace
        self._config = config
        self._peer: ZenohSession | None = None
        self._closed = False
        self._turn = asyncio.Lock()
        self._calls: dict[str, ZenohCall] = {}  # by stream, the latest of each that is not over

    async def open_call(self, stream_id: str) -> Call:
        peer = await self._connected()
        self._calls = {each.stream_id: each for each in self._calls.values() if not each.over}
        before = self._calls.get(stream_id)
        home = before.server_id if before else ""

        async def find(resumes: bool) -> ServerInfos:
            return await self._servers_for(stream_id, home=home if resumes else "")

        call = ZenohCall(peer, self._namespace, stream_id, find)
        self._calls[stream_id] = call
        return call

    async def ask(self, method: str, request: Message, answer: type[Answer]) -> Answer:
        """Of several servers that have an answer, the quickest's."""
        return next(iter((await self._ask_all(method, request, answer)).values()))

    async def close(self) -> None:
        for call in self._calls.values():
            call.lose(f"the connection to {self._endpoint} was closed")
        async with self._turn:
            self._closed = True
            peer, self._peer = self._peer, None
            if peer is not None:
                await peer.close()

    async def _connected(self) -> ZenohSession:
        async with self._turn:
            if self._closed:
                raise RuntimeError("the client was closed")
            if self._peer is None:
                config = make_config(
                    self._config,
                    max_message_bytes=_MAX_MESSAGE_BYTES,
                    mode="client",
                    connect__endpoints=[self._endpoint],
                    connect__timeout_ms=_CONNECT_TIMEOUT_MS,
                    scouting__multicast__enabled=False,  # whatever the file says of it
                )
                peer = ZenohSession(config)
                try:
                    await peer.open()
                except zenoh.ZError as error:
                    raise self._lost(error) from None
                self._peer = peer
            return self._peer

    def _lost(self, error: zenoh.ZError) -> ConnectionLost:
        return ConnectionLost(f"no connection to {self._endpoint}: {reason_of(error)}")

    async def _servers_for(self, stream_id: str, *, home: str) -> ServerInfos:
        """Where to open a stream, best first: the server that has it, else by load.

        ``home`` is the server that had it, if it is to be resumed. Raises ConnectionLost: no
        server answers, or not that one.
        """
        question = pb.GetStreamRequest(stream_id=stream_id)
        # Both at once: a server that hangs is waited for, and an opening has not long.
        infos, holders = await asyncio.gather(
            self._ask_all("GetServerInfo", pb.GetServerInfoRequest(), pb.GetServerInfoResponse),
            self._holders(question),
        )
        if home and home not in infos:
            raise ConnectionLost(f"the server of stream {stream_id!r} is not on the network")
        known = [each for each in holders if each in infos] or [home] * bool(home)
        ids = known or sorted(infos, key=lambda each: _load(infos[each]))
        return {each: infos[each] for each in ids}

    async def _holders(self, question: pb.GetStreamRequest) -> list[str]:
        """Ids of the servers, one at most, that have the stream."""
        try:
            return list(await self._ask_all("GetStream", question, pb.GetStreamResponse))
        except (UnknownStream, StreamExpired):
            return []

    async def _ask_all(
        self, method: str, question: Message, kind: type[Answer]
    ) -> dict[str, Answer]:
        """What each server that knows an answer says, by its id.

        Raises the error that says most, if none does; ConnectionLost: there is no server.
        """
        peer = await self._connected()
        key = query_key(self._namespace, ANY, UNARY_KEYS[method])
        try:
            answers = await peer.query(key, question, timeout_s=_ASK_TIMEOUT_S)
        except zenoh.ZError as error:
            raise self._lost(error) from None
        refusals = [each.error for each in answers if each.error is not None]
        if known := [each for each in answers if each.error is None]:
            return {each.server_id: kind.FromString(each.payload) for each in known}
        if refusals:
            raise max(refusals, key=_says)
        raise ConnectionLost(
            f"no server answers in namespace {self._namespace!r} at {self._endpoint}"
        )


def _load(info: pb.GetServerInfoResponse) -> tuple[float, float]:
    # Of servers that are alike one by chance, or all clients would choose the same.
    return info.streams_open / max(info.streams_max, 1), random.random()


def _says(refusal: DepthError) -> int:
    """That a server never had a stream says less than that another had it."""
    return 0 if isinstance(refusal, UnknownStream) else 1
