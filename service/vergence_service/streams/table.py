"""The table of open streams: their owners, limits and expiry."""

import hmac
import logging
import secrets
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from vergence_proto.errors import (
    BadCalibration,
    StateMemory,
    StreamExists,
    StreamExpired,
    StreamLimit,
    Superseded,
    Unauthenticated,
    UnknownStream,
)
from vergence_proto.types import Origin, StereoRig, checked_stream_id
from vergence_service.access.principals import LOCAL, Principal
from vergence_service.process.logs import log_event
from vergence_service.process.memory import MemoryBudget, MemoryHold, StreamMemory
from vergence_service.process.metrics import Metrics
from vergence_service.streams.quotas import Quotas, User
from vergence_service.streams.rectify import Rectifier
from vergence_service.streams.stream import (
    Attachment,
    Notice,
    NoticeKind,
    Stream,
    StreamConfig,
    key_of,
)

log = logging.getLogger(__name__)

# The server remembers for this long that a stream expired, and reports it as such.
_TOMBSTONE_S = 300.0


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """A place that is reserved for a stream."""

    stream_id: str
    client: str
    memory: MemoryHold
    owner: Principal = LOCAL

    @property
    def key(self) -> str:
        return key_of(self.owner.name, self.stream_id)


class StreamTable:
    """All streams of one server, within its limits. ``clock`` returns seconds.

    A stream belongs to a principal. Two principals may both have a stream of one id, and each knows
    only its own.

    ``on_closed`` is called with every stream that was closed or has expired.
    """

    def __init__(
        self,
        *,
        capacity: int,
        memory: MemoryBudget,
        idle_timeout_s: float,
        idle_notice_s: float,
        detach_grace_s: float,
        silent_s: float,
        clock: Callable[[], float],
        metrics: Metrics,
        on_closed: Callable[[Stream], None],
        quotas: Quotas,
    ) -> None:
        self.capacity = capacity
        self.idle_timeout_s = idle_timeout_s
        self.detach_grace_s = detach_grace_s
        self._quotas = quotas
        self._memory = memory
        self._idle_notice_s = idle_notice_s
        self._silent_s = silent_s
        self._clock = clock
        self._metrics = metrics
        self._on_closed = on_closed
        # By their keys: owner and id.
        self._streams: dict[str, Stream] = {}
        self._opening: dict[str, User] = {}  # reserved places
        self._expired_s: dict[str, float] = {}  # tombstones
        # Connections that have lost their stream and must end, and the user of each. They count
        # towards the limits until they have ended.
        self._leaving: dict[Attachment, User] = {}

    def __len__(self) -> int:
        return len(self._streams)

    def __iter__(self) -> Iterator[Stream]:
        return iter(list(self._streams.values()))

    def attachments(self) -> Iterable[Attachment]:
        return [stream.attachment for stream in self._streams.values() if stream.attachment]

    @contextmanager
    def reserve(
        self, stream_id: str, need: StreamMemory, *, client: str, owner: Principal = LOCAL
    ) -> Iterator[Place]:
        """Reserve a place for a stream, to be used in the block. If the id is empty, choose one.

        What takes long to make for a stream is made in this block, so that no refused opening
        costs more than a look at the limits.

        Raises BadShape if the id is not allowed, StreamExists if it is in use, FrameTooLarge if the
        stream needs more than all memory, and Quota, StreamLimit or StateMemory if a limit is
        reached.
        """
        self.sweep()
        stream_id = stream_id or f"s-{secrets.token_hex(8)}"
        checked_stream_id(stream_id)
        key = key_of(owner.name, stream_id)
        if key in self._streams or key in self._opening:
            raise StreamExists(
                f"stream {stream_id!r} is open; resume it with its token, close it, or choose "
                "another id"
            )
        others = [*self._leaving.values(), *self._opening.values()]
        self._quotas.check(
            owner,
            client,
            need,
            streams=list(self._streams.values()),
            others=others,
            now_s=self._clock(),
            next_expiry_s=self._next_expiry_s,
        )
        if len(self._streams) + len(others) >= self.capacity:
            raise StreamLimit(
                f"the server has {self.capacity} open streams, its limit; close one, or "
                "try again later (the server's setting streams.capacity)",
                retry_after_s=self._next_expiry_s(self._streams.values()),
            )
        try:
            place = Place(stream_id, client, self._memory.hold_stream(need), owner)
        except StateMemory as error:
            error.retry_after_s = self._next_expiry_s(self._streams.values())
            raise
        self._opening[key] = User(owner.name, client, need.own)
        try:
            yield place
        finally:
            del self._opening[key]
            if key not in self._streams:
                place.memory.release()

    def open(
        self,
        place: Place,
        config: StreamConfig,
        rectifier: Rectifier,
        *,
        attachment: Attachment | None,
        resume_token: bytes = b"",
    ) -> Stream:
        """Open a stream at a place that :meth:`reserve` has reserved.

        ``resume_token``: the one of a stream that another server had. Empty: the stream is new.
        """
        self._expired_s.pop(place.key, None)
        stream = Stream(
            place.stream_id,
            place.client,
            resume_token or secrets.token_bytes(16),
            config,
            rectifier,
            place.memory,
            attachment,
            self._clock(),
            owner=place.owner,
            transport=attachment.transport if attachment else "",
            trace_parent=attachment.trace_parent if attachment else None,
        )
        self._streams[place.key] = stream
        self._metrics.streams_opened.inc()
        self._metrics.openings.labels("resumed" if resume_token else "opened").inc()
        size = f"{config.rig.left.width}x{config.rig.left.height}"
        what = "stream resumed from its snapshot" if resume_token else "stream opened"
        log_event(log, what, **_about(stream), size=size)
        self._count()
        return stream

    def attach(
        self,
        stream_id: str,
        resume_token: bytes,
        config: StreamConfig,
        *,
        attachment: Attachment,
        client: str,
        owner: Principal = LOCAL,
    ) -> Stream:
        """Attach a new connection to an open stream; the newest connection wins.

        Raises UnknownStream or StreamExpired if the stream is gone, StreamExists if the token
        belongs to another stream, and BadCalibration if the rig has changed.
        """
        stream = self.get(stream_id, owner=owner.name)
        if not hmac.compare_digest(resume_token, stream.resume_token):
            raise StreamExists(f"stream {stream_id!r} is open, and the resume token is wrong")
        if not _same_rig(stream.config.rig, config.rig):
            raise BadCalibration(
                f"stream {stream_id!r} was opened with another rig; open a new stream for this one"
            )
        if stream.attachment is not None:
            self._leaving[stream.attachment] = User(stream.owner.name, stream.client)
            stream.attachment.end(
                Superseded(f"a newer connection attached to stream {stream_id!r}")
            )
        stream.config = config
        stream.attachment = attachment
        stream.transport, stream.trace_parent = attachment.transport, attachment.trace_parent
        stream.client = client  # the client may have changed its network
        stream.owner = owner  # and its token
        if stream.state is not None:
            stream.origin = Origin.RESUMED
        self._metrics.openings.labels("resumed").inc()
        log_event(log, "stream resumed", **_about(stream))
        self.touch(stream)
        return stream

    def detach(self, stream: Stream, attachment: Attachment) -> None:
        """Detach a connection that has ended; its stream waits for the next connection."""
        self._leaving.pop(attachment, None)
        if stream.attachment is attachment:
            stream.attachment = None
            self.touch(stream)
            if self._streams.get(stream.key) is stream:
                log_event(log, "stream detached", **_about(stream))

    def get(self, stream_id: str, *, owner: str = LOCAL.name) -> Stream:
        """Return an open stream of a principal.

        Raises StreamExpired if it expired in the last five minutes, otherwise UnknownStream.
        """
        key = key_of(owner, stream_id)
        stream = self._streams.get(key)
        if stream is not None and self._clock() >= self._expiry_s(stream):
            self._expire(stream)
        elif stream is not None:
            return stream
        if key in self._expired_s:
            raise StreamExpired(
                f"stream {stream_id!r} had no connection for {self.detach_grace_s:g} s "
                f"or without a frame for {self.idle_timeout_s:g} s; open it again"
            )
        raise UnknownStream(f"no open stream {stream_id!r}; open it before sending frames")

    def find(self, key: str) -> Stream | None:
        """Return the open stream of a key, if there is one."""
        self.sweep()
        return self._streams.get(key)

    def made_by(
        self, stream_id: str, opening_id: bytes, *, owner: str = LOCAL.name
    ) -> Stream | None:
        """Return the open stream that an earlier message of the same opening has made."""
        stream = self._streams.get(key_of(owner, stream_id))
        same = stream is not None and hmac.compare_digest(opening_id, stream.config.opening_id)
        return stream if same and opening_id else None

    def touch(self, stream: Stream) -> None:
        """Record that the stream is in use: its time until expiry starts again."""
        stream.active_s = self._clock()
        stream.warned = False

    def close(self, stream: Stream) -> None:
        """End a stream, and free its state and what was learnt about it."""
        if self._streams.get(stream.key) is stream:
            del self._streams[stream.key]
            self._metrics.streams_closed.inc()
            log_event(
                log,
                "stream closed",
                **_about(stream),
                stepped=stream.frames_stepped,
                dropped=stream.frames_dropped,
                failed=stream.frames_failed,
            )
            stream.memory.release()
            if stream.attachment is not None:
                self._leaving[stream.attachment] = User(stream.owner.name, stream.client)
            self._count()
            self._on_closed(stream)

    def end_those_of(self, gone: Callable[[Principal], bool]) -> None:
        """End the streams of principals whose credential is gone."""
        for stream in self:
            if gone(stream.owner):
                self.close(stream)
                if stream.attachment is not None:
                    stream.attachment.end(Unauthenticated("the token was removed"))

    def sweep(self) -> None:
        """Expire the streams that are due, warn those that will be soon, and lose silent clients.

        A stream whose frame waits or is stepped is in use.
        """
        now_s = self._clock()
        for stream in list(self._streams.values()):
            if _in_use(stream):
                self.touch(stream)
            attachment = stream.attachment
            left_s = self._expiry_s(stream) - now_s
            if left_s <= 0:
                self._expire(stream)
            elif attachment is not None and attachment.silent_s >= self._silent_s:
                attachment.lose(
                    f"the client sent nothing for {self._silent_s:g} s, not even a ping"
                )
            elif attachment is not None and left_s <= self._idle_notice_s and not stream.warned:
                stream.warned = True
                message = f"no frame for {now_s - stream.active_s:.0f} s: the stream will expire"
                attachment.notify(Notice(NoticeKind.EXPIRING, message, left_s))
        for key, expired_s in list(self._expired_s.items()):
            if now_s - expired_s > _TOMBSTONE_S:
                del self._expired_s[key]

    def idle_s(self, stream: Stream) -> float:
        """Return the time since the stream was last in use."""
        return 0.0 if _in_use(stream) else self._clock() - stream.active_s

    def _expire(self, stream: Stream) -> None:
        why = "idle" if stream.attachment is not None else "detached"
        self._metrics.streams_expired.labels(why).inc()
        log_event(log, "stream expired", **_about(stream), why=why)
        self.close(stream)
        self._expired_s[stream.key] = self._clock()
        if stream.attachment is not None:
            stream.attachment.end(
                StreamExpired(
                    f"stream {stream.stream_id!r} had no frame for {self.idle_timeout_s:g} s; "
                    "open it again"
                )
            )

    def _expiry_s(self, stream: Stream) -> float:
        patience_s = self.idle_timeout_s if stream.attachment else self.detach_grace_s
        return (self._clock() if _in_use(stream) else stream.active_s) + patience_s

    def _next_expiry_s(self, streams: Iterable[Stream]) -> float:
        # Without a stream, only connections that are about to end are in the way.
        return min(map(self._expiry_s, streams), default=self._clock() + 1.0) - self._clock()

    def _count(self) -> None:
        self._metrics.streams_open.set(len(self._streams))


def _about(stream: Stream) -> dict[str, object]:
    return {
        "stream": stream.stream_id,
        "principal": stream.owner.name,
        "transport": stream.transport,
        "address": stream.client,
        **({"trace_id": stream.trace_parent.trace_id} if stream.trace_parent else {}),
    }


def _in_use(stream: Stream) -> bool:
    """Decide whether a frame of the stream waits or is stepped."""
    return stream.turn.locked() or (stream.attachment is not None and stream.attachment.busy)


def _same_rig(one: StereoRig, other: StereoRig) -> bool:
    return (one.left, one.right) == (other.left, other.right) and np.array_equal(
        one.left_from_right.matrix, other.left_from_right.matrix
    )
