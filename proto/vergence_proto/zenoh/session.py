"""A Zenoh session in asyncio, as both ends of a stream use it. Needs the ``zenoh`` extra.

Zenoh calls back in threads of its own, from which it must not be called again, and blocks where a
message must wait. So what comes only crosses into the event loop, and what goes out is handed over
in worker threads.
"""

import asyncio
import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
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
from vergence_proto.zenoh.keys import encoding_of, server_of

Value = TypeVar("Value")

# A lossless message that waits for a slow receiver holds a thread; these are not the event loop's
# own, which decode images and must not run out.
_THREADS = 32

_DEFAULTS: dict[str, Any] = {
    # Nobody is found by chance: endpoints are named.
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "scouting/delay": 0,  # for those that are found
    # A node that vanished without a word is noticed after this, not after ten seconds.
    "transport/link/tx/lease": 5000,
    # A raw pair takes longer than the default of 50 ms to leave over Wi-Fi, and every one would be
    # dropped; credit bounds how many wait. In microseconds.
    "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": 500_000,
    # Zenoh waits seconds between attempts, and a stream has only the server's grace to come back.
    "connect/retry": {"period_init_ms": 50, "period_max_ms": 500, "period_increase_factor": 2},
}


class Undeclarable(Protocol):
    def undeclare(self) -> None: ...


@dataclass(frozen=True, slots=True)
class Answer:
    """One server's answer to a query: the message's bytes, or the error it refused with."""

    server_id: str  # empty with an error: Zenoh does not tell whose it is
    payload: bytes
    error: DepthError | None


def make_config(
    file: Path | None = None, /, *, max_message_bytes: int, **settings: Any
) -> zenoh.Config:
    """A configuration from a Zenoh JSON5 file, else of our defaults; then ``settings`` by key.

    Keys are Zenoh's with ``__`` for the slash. Raises zenoh.ZError: the file is not one.
    """
    config = zenoh.Config.from_file(file) if file else zenoh.Config()
    values = {
        **({} if file else _DEFAULTS),
        # The default would let one message take a gigabyte of memory.
        "transport/link/rx/max_message_size": max_message_bytes,
        **{key.replace("__", "/"): value for key, value in settings.items()},
    }
    for key, value in values.items():
        config.insert_json5(key, json.dumps(value))
    return config


def reason_of(error: zenoh.ZError) -> str:
    """What Zenoh says, without the place in its own source."""
    return str(error).partition(" at /")[0]


class ZenohPeer:
    """A session from :meth:`open` to :meth:`close`. Methods raise zenoh.ZError."""

    def __init__(self, config: zenoh.Config) -> None:
        self._config = config
        self._closed = False
        self._threads = ThreadPoolExecutor(_THREADS, thread_name_prefix="zenoh")

    async def open(self) -> None:
        self._loop = asyncio.get_running_loop()
        try:
            self._session = await self._in_thread(lambda: zenoh.open(self._config))
        except BaseException:
            self._threads.shutdown(wait=False)
            raise
        self.id = str(self._session.zid())

    async def close(self) -> None:
        # Without it the interpreter hangs on its way out.
        await self._in_thread(self._session.close)
        self._closed = True
        self._threads.shutdown(wait=False)

    async def put(
        self, key: str, message: Message, *, attachment_id: str, may_drop: bool = False
    ) -> None:
        """Send a message. On a way that is full it waits there, or is dropped if it may be."""

        def put() -> None:
            self._session.put(
                key,
                message.SerializeToString(),
                encoding=encoding_of(message),
                attachment=attachment_id,
                congestion_control=(
                    zenoh.CongestionControl.DROP if may_drop else zenoh.CongestionControl.BLOCK
                ),
                # One priority for all, or messages would overtake one another.
                priority=zenoh.Priority.REAL_TIME,
                express=True,
            )

        await self._in_thread(put)

    async def ask(
        self, key: str, question: Message, *, timeout_s: float, attachment_id: str = ""
    ) -> list[Answer]:
        """What all those answer whose queryable matches; those that do not in time are left out."""
        replies: list[zenoh.Reply] = []
        done = asyncio.Event()
        handler = Callback(replies.append, self._to_loop(done.set), indirect=False)

        def get() -> None:
            self._session.get(
                key,
                handler,
                payload=question.SerializeToString(),
                encoding=encoding_of(question),
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
        return [_answer(reply) for reply in replies]

    async def subscribe(self, key: str, received: Callable[[zenoh.Sample], None]) -> Undeclarable:
        """``received`` is called in Zenoh's thread: it must not call Zenoh, nor wait."""
        handler = Callback(received, indirect=False)
        return await self._in_thread(lambda: self._session.declare_subscriber(key, handler))

    async def answer_queries(self, key: str, asked: Callable[[zenoh.Query], None]) -> Undeclarable:
        """``asked`` is called in the event loop, and must drop the query at last."""
        handler = Callback(self._to_loop(asked), indirect=False)
        return await self._in_thread(lambda: self._session.declare_queryable(key, handler))

    async def reply(self, query: zenoh.Query, key: str, message: Message) -> None:
        """Answer a query, on a concrete key of ours that matches it, and drop it."""

        def reply() -> None:
            with query:
                query.reply(key, message.SerializeToString(), encoding=encoding_of(message))

        await self._in_thread(reply)

    async def refuse(self, query: zenoh.Query, status: status_pb2.Status) -> None:
        """Answer a query with an error, and drop it."""

        def refuse() -> None:
            with query:
                query.reply_err(status.SerializeToString(), encoding=encoding_of(status))

        await self._in_thread(refuse)

    async def declare_alive(self, key: str) -> Undeclarable:
        """A liveliness token, which goes when this session or the way to it does."""
        return await self._in_thread(lambda: self._session.liveliness().declare_token(key))

    async def watch_deaths(self, key: str, died: Callable[[str], None]) -> Undeclarable:
        """``died`` is called in the event loop with the key of every token that goes."""

        def changed(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.DELETE:
                died(str(sample.key_expr))

        handler = Callback(self._to_loop(changed), indirect=False)
        return await self._in_thread(
            lambda: self._session.liveliness().declare_subscriber(key, handler, history=True)
        )

    async def undeclare(self, *declared: Undeclarable) -> None:
        if self._closed:
            return  # and they are gone with it

        def undeclare() -> None:
            for each in declared:
                with suppress(zenoh.ZError):  # the session closes meanwhile
                    each.undeclare()

        await self._in_thread(undeclare)

    async def _in_thread(self, call: Callable[[], Value]) -> Value:
        if self._closed:
            raise zenoh.ZError("the session is closed")
        return await asyncio.get_running_loop().run_in_executor(self._threads, call)

    def _to_loop(self, function: Callable[..., None]) -> Callable[..., None]:
        def callback(*items: Any) -> None:  # whatever Zenoh hands to this kind of callback
            with suppress(RuntimeError):  # the loop has closed before the session
                self._loop.call_soon_threadsafe(function, *items)

        return callback


def _answer(reply: zenoh.Reply) -> Answer:
    if (sample := reply.ok) is not None:
        return Answer(server_of(str(sample.key_expr)), sample.payload.to_bytes(), None)
    assert reply.err is not None
    return Answer("", b"", _error(reply.err))


def _error(error: zenoh.ReplyError) -> DepthError:
    payload = error.payload.to_bytes()
    with suppress(DecodeError):
        if refusal := codec.error_from_status(status_pb2.Status.FromString(payload)):
            return refusal
    return ModelFailed(f"the server answered with an error that is not ours: {payload[:200]!r}")
