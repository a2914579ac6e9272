"""A Zenoh session for asyncio, used by client and server. It needs the ``zenoh`` extra.

Zenoh runs callbacks in its own threads, in which Zenoh must not be called, and it blocks while a
message has to wait. Incoming messages are therefore passed on to the event loop, and outgoing ones
are sent from worker threads.
"""

import asyncio
import json
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

import zenoh
from google.protobuf.message import DecodeError, Message
from google.rpc import status_pb2
from zenoh.handlers import Callback

from vergence_proto import codec
from vergence_proto.errors import DepthError, ModelFailed
from vergence_proto.zenoh.closing import close_without_lingering
from vergence_proto.zenoh.json5_keys import keys_of
from vergence_proto.zenoh.keys import encoding_of, server_of
from vergence_proto.zenoh.link_settings import LEASE_MS, WAITS_BEFORE_DROP

Value = TypeVar("Value")

# A lossless message that waits for a slow receiver holds a thread. The session has threads of its
# own, because the event loop's default ones decode images and must stay free.
_THREADS = 32
_CLOSE_S = 0.3

_DROP = "transport/link/tx/queue/congestion_control/drop"

_DEFAULTS: dict[str, Any] = {
    # Connect only to configured endpoints.
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "scouting/delay": 0,  # no time is spent on finding others
    "transport/link/tx/lease": LEASE_MS,
    **{f"{_DROP}/{name}": wait_us for name, wait_us in WAITS_BEFORE_DROP.items()},
    # The default waits seconds between attempts, and a stream must resume within the server's
    # grace period.
    "connect/retry": {"period_init_ms": 50, "period_max_ms": 500, "period_increase_factor": 2},
}


class Declaration(Protocol):
    """A subscriber, queryable or liveliness token of a Zenoh session."""

    def undeclare(self) -> None: ...


@dataclass(frozen=True, slots=True)
class QueryReply:
    """One server's reply to a query: the bytes of a message, or an error."""

    server_id: str  # the server that replied; empty for an error, since Zenoh does not report it
    payload: bytes
    error: DepthError | None


def make_config(
    file: Path | None = None, /, *, max_message_bytes: int, **settings: Any
) -> zenoh.Config:
    """Make a configuration: the project's defaults, what a Zenoh JSON5 file sets, ``settings``.

    ``settings`` override single values; their names are Zenoh's keys with ``__`` for the slash.
    Raises zenoh.ZError: the file is no Zenoh configuration.
    """
    config = zenoh.Config.from_file(file) if file else zenoh.Config()
    in_file = set(keys_of(file.read_text("utf-8"))) if file else set()
    values = {
        **{key: value for key, value in _DEFAULTS.items() if not _has(in_file, key)},
        # With the default, one message may use a gigabyte of memory.
        "transport/link/rx/max_message_size": max_message_bytes,
        **{key.replace("__", "/"): value for key, value in settings.items()},
    }
    for key, value in values.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _has(keys: set[str], key: str) -> bool:
    """Return whether a key, or a part of it, is among ``keys``."""
    return any(each == key or each.startswith(f"{key}/") for each in keys)


def user_of(config: zenoh.Config) -> str:
    """Return the user name in a configuration; empty if there is none."""
    return json.loads(config.get_json("transport/auth/usrpwd/user")) or ""


def reason_of(error: zenoh.ZError) -> str:
    """Return Zenoh's message without the line of Zenoh's source code."""
    return str(error).partition(" at /")[0]


class ZenohSession:
    """A Zenoh session, usable from :meth:`open` to :meth:`close`.

    Every method raises zenoh.ZError: Zenoh failed, or the session is closed.
    """

    def __init__(self, config: zenoh.Config) -> None:
        self._config = config
        self.user: str = user_of(config)  # empty: without a name
        self._closed = False
        self._threads = ThreadPoolExecutor(_THREADS, thread_name_prefix="zenoh")

    async def open(self) -> None:
        """Open the session and learn its ``id``. Call this once, in the event loop to use."""
        self._loop = asyncio.get_running_loop()
        opening = self._threads.submit(zenoh.open, self._config)
        try:
            self._session = await asyncio.wrap_future(opening)
        except BaseException:
            opening.add_done_callback(_close)  # a thread cannot be cancelled
            self._threads.shutdown(wait=False)
            raise
        self.id: str = str(self._session.zid())

    async def close(self) -> None:
        """Close the session, and with it everything that it declared.

        What takes longer, a thread goes on with.
        """
        self._closed = True
        # The interpreter does not exit while a session is open.
        closing = asyncio.wrap_future(self._threads.submit(close_without_lingering, self._session))
        self._threads.shutdown(wait=False)
        done, _ = await asyncio.wait({closing}, timeout=_CLOSE_S)
        if done:
            with suppress(zenoh.ZError):  # it is closed all the same
                closing.result()
        else:
            closing.cancel()

    async def put(
        self, key: str, message: Message, *, attachment_id: str, may_drop: bool = False
    ) -> None:
        """Send a message. On a congested link it waits, or is dropped if ``may_drop`` is set."""

        def put() -> None:
            self._session.put(
                key,
                message.SerializeToString(),
                encoding=encoding_of(message),
                attachment=attachment_id,
                congestion_control=(
                    zenoh.CongestionControl.DROP if may_drop else zenoh.CongestionControl.BLOCK
                ),
                # All messages have one priority, or they would overtake one another.
                priority=zenoh.Priority.REAL_TIME,
                express=True,
            )

        await self._in_thread(put)

    async def query(
        self, key: str, request: Message, *, timeout_s: float, attachment_id: str = ""
    ) -> list[QueryReply]:
        """Return the replies of all matching servers that reply within ``timeout_s``."""
        replies: list[zenoh.Reply] = []
        done = asyncio.Event()
        handler = Callback(replies.append, self._to_loop(done.set), indirect=False)

        def get() -> None:
            self._session.get(
                key,
                handler,
                payload=request.SerializeToString(),
                encoding=encoding_of(request),
                attachment=attachment_id,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=timeout_s,
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.REAL_TIME,
                express=True,
            )

        await self._in_thread(get)
        await done.wait()
        return [_received(reply) for reply in replies]

    async def subscribe(self, key: str, received: Callable[[zenoh.Sample], None]) -> Declaration:
        """Call ``received`` in Zenoh's thread for each sample; it must not wait or call Zenoh."""
        handler = Callback(received, indirect=False)
        return await self._in_thread(lambda: self._session.declare_subscriber(key, handler))

    async def answer_queries(self, key: str, asked: Callable[[zenoh.Query], None]) -> Declaration:
        """Call ``asked`` in the event loop for each query; it must drop the query in the end."""
        handler = Callback(self._to_loop(asked), indirect=False)
        return await self._in_thread(lambda: self._session.declare_queryable(key, handler))

    async def reply(self, query: zenoh.Query, key: str, message: Message) -> None:
        """Reply to a query on ``key``, a key without wildcards that matches it, and drop it."""

        def reply() -> None:
            with query:
                query.reply(key, message.SerializeToString(), encoding=encoding_of(message))

        await self._to_the_end(reply)

    async def refuse(self, query: zenoh.Query, status: status_pb2.Status) -> None:
        """Reply to a query with an error, and drop it."""

        def refuse() -> None:
            with query:
                query.reply_err(status.SerializeToString(), encoding=encoding_of(status))

        await self._to_the_end(refuse)

    async def declare_liveliness(self, key: str) -> Declaration:
        """Declare a liveliness token, which vanishes when this session or the link to it ends."""
        return await self._in_thread(lambda: self._session.liveliness().declare_token(key))

    async def watch_liveliness(self, key: str, vanished: Callable[[str], None]) -> Declaration:
        """Call ``vanished`` in the event loop with the key of every token that vanishes."""

        def changed(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.DELETE:
                vanished(str(sample.key_expr))

        handler = Callback(self._to_loop(changed), indirect=False)
        return await self._in_thread(
            lambda: self._session.liveliness().declare_subscriber(key, handler, history=True)
        )

    async def undeclare(self, *declared: Declaration) -> None:
        """Undeclare them; a session that is closed has done so already."""
        if self._closed:
            return

        def undeclare() -> None:
            for each in declared:
                with suppress(zenoh.ZError):  # the session closes at the same time
                    each.undeclare()

        await self._in_thread(undeclare)

    async def _to_the_end(self, call: Callable[[], Value]) -> Value:
        """Run a call that uses a query. If the caller is cancelled, it must not drop it before."""
        running = asyncio.ensure_future(self._in_thread(call))
        try:
            return await asyncio.shield(running)
        except asyncio.CancelledError:
            await asyncio.wait([running])
            raise

    async def _in_thread(self, call: Callable[[], Value]) -> Value:
        if self._closed:
            raise zenoh.ZError("the session is closed")
        return await asyncio.get_running_loop().run_in_executor(self._threads, call)

    def _to_loop(self, function: Callable[..., None]) -> Callable[..., None]:
        def callback(*items: Any) -> None:  # the arguments depend on the kind of callback
            with suppress(RuntimeError):  # the loop has closed before the session
                self._loop.call_soon_threadsafe(function, *items)

        return callback


def _close(opening: "Future[zenoh.Session]") -> None:
    """Close a session that nobody waits for any more."""
    if not opening.cancelled() and opening.exception() is None:
        close_without_lingering(opening.result())


def _received(reply: zenoh.Reply) -> QueryReply:
    if (sample := reply.ok) is not None:
        return QueryReply(server_of(str(sample.key_expr)), sample.payload.to_bytes(), None)
    assert reply.err is not None
    return QueryReply("", b"", _error(reply.err))


def _error(error: zenoh.ReplyError) -> DepthError:
    payload = error.payload.to_bytes()
    with suppress(DecodeError):
        if refusal := codec.error_from_status(status_pb2.Status.FromString(payload)):
            return refusal
    return ModelFailed(
        f"expected a google.rpc.Status of Vergence as the error, got {payload[:200]!r}"
    )
