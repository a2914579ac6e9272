"""``vergence.v1`` over Zenoh: queries for methods, keys for streams, tokens for liveliness."""

import asyncio
import logging
import re
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from pathlib import Path
from typing import Any, Self, TypeVar

import zenoh
from google.protobuf.message import Message

from vergence_proto.codec import read_small
from vergence_proto.errors import BadShape, DepthError
from vergence_proto.v1 import depth_pb2 as pb
from vergence_proto.zenoh.keys import (
    ANY,
    LOCAL_PRINCIPAL,
    OPEN,
    UNARY_KEYS,
    StreamKeys,
    place_of,
    principal_of,
    query_key,
    server_key,
)
from vergence_proto.zenoh.session import ZenohSession, make_config, reason_of
from vergence_service.access.gate import Gate
from vergence_service.access.principals import Principal
from vergence_service.transports.errors import ZenohUnreachable
from vergence_service.transports.open_calls import FINISHING_SHARE, OpenCalls
from vergence_service.transports.unary import UnaryMethods
from vergence_service.transports.zenoh.call import ZenohCall
from vergence_service.transports.zenoh.errors import status_of

log = logging.getLogger(__name__)

# A frame just above the limit is still received, so that the error can name the limit.
_ROOM_OVER_THE_LIMIT = 1.25
_ATTACHMENT_ID = re.compile("[0-9a-f]{32}")

Question = TypeVar("Question", bound=Message)
_Method = Callable[[Any, Principal], Awaitable[Message]]


def zenoh_config(
    file: Path | None,
    *,
    mode: str,
    listen: Sequence[str],
    connect: Sequence[str],
    shared_memory: bool,
    max_frame_bytes: int,
    namespace: str,
) -> zenoh.Config:
    """Make the configuration, from a file or from mode and endpoints.

    Without a file, a router lets nobody else answer in the server's name.

    Raises ZenohUnreachable if it is not a configuration.
    """
    bound = int(max_frame_bytes * _ROOM_OVER_THE_LIMIT)
    try:
        if file is not None:
            return make_config(file, max_message_bytes=bound)
        return make_config(
            max_message_bytes=bound,
            mode=mode,
            listen__endpoints=list(listen),
            connect__endpoints=list(connect),
            transport__shared_memory__enabled=shared_memory,
            access_control=only_server_answers(namespace) if mode == "router" else {},
        )
    except zenoh.ZError as error:
        raise ZenohUnreachable(reason_of(error)) from None


def only_server_answers(namespace: str) -> dict[str, Any]:
    """Return access control for a router without users: no other node answers queries.

    Nobody needs to be kept from reading: the keys of a stream contain a secret.
    """
    rule = {
        "id": "answers",
        "permission": "deny",
        "flows": ["ingress"],
        "messages": ["declare_queryable", "reply", "liveliness_token"],
        "key_exprs": [f"{namespace}/v1/@{LOCAL_PRINCIPAL}/@server/**", server_key(namespace)],
    }
    return {
        "enabled": True,
        "default_permission": "allow",
        "rules": [rule],
        "subjects": [{"id": "everybody"}],
        "policies": [{"rules": ["answers"], "subjects": ["everybody"]}],
    }


class ZenohServer:
    """Is on the network as long as its context lasts. It answers after :meth:`serving`.

    Entering the context raises ZenohUnreachable if the network cannot be joined.
    """

    def __init__(
        self,
        unary: UnaryMethods,
        calls: OpenCalls,
        *,
        gate: Gate,
        config: zenoh.Config,
        namespace: str,
    ) -> None:
        self._gate = gate
        self._calls = calls
        self._namespace = namespace
        self._peer = ZenohSession(config)
        self._methods: Mapping[str, tuple[type[Message], _Method]] = {
            UNARY_KEYS["GetServerInfo"]: (pb.GetServerInfoRequest, unary.server_info),
            UNARY_KEYS["GetStream"]: (pb.GetStreamRequest, unary.stream),
            UNARY_KEYS["ResetStream"]: (pb.ResetStreamRequest, unary.reset),
            UNARY_KEYS["CloseStream"]: (pb.CloseStreamRequest, unary.close),
        }
        self._attached: dict[str, asyncio.Task[None]] = {}  # by attachment id
        self._tasks: set[asyncio.Task[None]] = set()

    async def __aenter__(self) -> Self:
        try:
            await self._peer.open()
        except zenoh.ZError as error:
            raise ZenohUnreachable(reason_of(error)) from None
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self._peer.close()

    async def serving(self) -> None:
        """Answer queries, and declare this server alive on the network."""
        peer, namespace = self._peer, self._namespace
        tokens = self._gate.tokens
        names = [LOCAL_PRINCIPAL] if self._gate.open else sorted(tokens.names() if tokens else ())
        # Kept as long as this server serves: Zenoh removes declarations without references.
        self._declared = [
            *[
                await peer.answer_queries(query_key(namespace, name, peer.id, ANY), self._asked)
                for name in names
            ],
            await peer.declare_liveliness(server_key(namespace, peer.id)),
        ]

    async def drain(self, *, within_s: float) -> None:
        """Wait until all calls end; after ``within_s``, answer what they have sent and end them."""
        await self._calls.drain(within_s=within_s)
        if self._tasks:
            await asyncio.wait(self._tasks, timeout=FINISHING_SHARE * within_s)

    def _asked(self, query: zenoh.Query) -> None:
        what = str(query.key_expr).rpartition("/")[2]
        if what != OPEN:
            self._start(self._answer(query, what))
            return
        attachment_id = (
            query.attachment.to_bytes().decode(errors="replace") if query.attachment else ""
        )
        if not _ATTACHMENT_ID.fullmatch(attachment_id) or attachment_id in self._attached:
            error = BadShape("expected a new attachment id of 32 hex digits with each open query")
            self._start(self._peer.refuse(query, status_of(error)))
            return
        task = self._start(self._open(query, attachment_id))
        # At once, so that the end of the client, if it comes next, finds the call.
        self._attached[attachment_id] = task
        task.add_done_callback(lambda _: self._attached.pop(attachment_id))

    def _client_died(self, key: str) -> None:
        if task := self._attached.get(key.rpartition("/")[2]):
            task.cancel()  # its stream is detached and kept for detach_grace_s

    def _caller(self, query: zenoh.Query) -> Principal:
        """Return the principal of a query: Zenoh lets others not use its key."""
        return self._gate.named(principal_of(str(query.key_expr)))

    async def _open(self, query: zenoh.Query, attachment_id: str) -> None:
        with query:  # Zenoh ends the query at the latest when the call ends
            try:
                caller = self._caller(query)
                opening = _read(query, pb.OpenStream)
            except DepthError as error:
                await self._peer.refuse(query, status_of(error))
                return
            call = ZenohCall(
                self._peer,
                query,
                opening,
                namespace=self._namespace,
                attachment_id=attachment_id,
                caller=caller,
                calls=self._calls,
            )
            if not opening.stream_id:  # then the client cannot know where to show that it is alive
                await call.run()
                return
            place = place_of(caller.name, attachment_id)
            token = StreamKeys(self._namespace, place, opening.stream_id).client(attachment_id)
            watching = await self._peer.watch_liveliness(token, self._client_died)
            try:
                await call.run()
            finally:
                await self._peer.undeclare(watching)

    async def _answer(self, query: zenoh.Query, what: str) -> None:
        try:
            if what not in self._methods:
                raise BadShape(f"expected one of {', '.join([OPEN, *self._methods])}, got {what!r}")
            question, method = self._methods[what]
            answer = await method(_read(query, question), self._caller(query))
        except Exception as error:
            await self._peer.refuse(query, status_of(error))
        else:
            principal = principal_of(str(query.key_expr))
            key = query_key(self._namespace, principal, self._peer.id, what)
            await self._peer.reply(query, key, answer)

    def _start(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._ended)
        return task

    def _ended(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()):
            log.error("a call could not be answered", exc_info=error)


def _read(query: zenoh.Query, kind: type[Question]) -> Question:
    """Read the payload of a query. Raises BadShape and FrameTooLarge."""
    return read_small(kind, query.payload.to_bytes() if query.payload else b"")
