"""Writes the snapshots of streams, beside their frames: no frame waits for the store."""

import asyncio
import logging
import secrets
from collections.abc import Callable, Coroutine
from typing import Any, Self

from vergence_service.inference.snapshots import BadSnapshot
from vergence_service.process.metrics import Metrics
from vergence_service.process.threads import ThreadPool
from vergence_service.snapshots.snapshot import StreamSnapshot
from vergence_service.snapshots.store import (
    Claim,
    Claimed,
    OwnedByOther,
    Owner,
    Saved,
    SnapshotStore,
    StoreUnavailable,
)

log = logging.getLogger(__name__)

# Snapshots up to this size are written after every frame, larger ones after so many frames, or
# after this time.
_LARGE_BYTES = 2 << 20
_LARGE_FRAMES = 10
_LARGE_S = 1.0
# A write that failed is tried again after this time. Until then, nobody waits for the store.
_PAUSE_S = 0.5
# The first write of a stream takes its key over from an earlier owner, but only so soon after the
# opening. A server that was suspended in between must not take over from its successor.
_TAKE_OVER_S = 2.0


class StreamSaver:
    """Writes the snapshots of one stream: at most one write at a time, and the newest wins.

    ``on_lost`` is called when another server has become the owner of the stream.
    """

    def __init__(
        self,
        snapshots: "Snapshots",
        key: str,
        owner: Owner,
        *,
        token_digest: str,
        rig_digest: str,
        on_lost: Callable[[], None],
    ) -> None:
        self._snapshots = snapshots
        self._key = key
        self.owner = owner
        self._token_digest = token_digest
        self._rig_digest = rig_digest
        self._on_lost = on_lost
        self._opened_s = snapshots.clock()
        self._newest: StreamSnapshot | None = None  # waits to be written
        self._writing: asyncio.Task[None] | None = None
        self._written_s = self._opened_s
        self._since = 0  # snapshots since the last one that was written
        self._closed = False
        self.saved_frame_id = 0  # the last frame of the stored snapshot

    def put(self, snapshot: StreamSnapshot, *, now: bool = False) -> None:
        """Write a snapshot soon. ``now``: even if it is large, and the last was written lately."""
        if self._closed:
            return
        self._newest = snapshot
        self._since += 1
        due = self._since >= _LARGE_FRAMES or self._snapshots.clock() - self._written_s >= _LARGE_S
        if now or due or snapshot.nbytes <= _LARGE_BYTES:
            self._begin()

    def write_now(self) -> None:
        """Write the newest snapshot, even if it is large and the last was written lately."""
        if self._newest is not None and not self._closed:
            self._begin()

    async def flush(self) -> None:
        """Write the newest snapshot, and wait until it is stored, unless the store fails."""
        self.write_now()
        if self._writing is not None:
            await asyncio.wait([self._writing], timeout=self._snapshots.patience_s)

    def close(self) -> None:
        """Write no more, and remove the snapshot: the stream has ended."""
        if not self._closed:
            self._closed = True
            self._snapshots.start(self._discard())

    def _begin(self) -> None:
        if self._writing is None:
            self._writing = self._snapshots.start(self._write_all())

    async def _write_all(self) -> None:
        try:
            while self._newest is not None and not self._closed:
                snapshot, self._newest = self._newest, None
                self._since = 0
                if not await self._write(snapshot):
                    self._newest = self._newest or snapshot
                    await asyncio.sleep(_PAUSE_S)
        finally:
            self._writing = None

    async def _write(self, snapshot: StreamSnapshot) -> bool:
        value = await self._snapshots.threads.run(snapshot.to_bytes)
        saved = Saved(
            self._key, value, self._token_digest, self._rig_digest, self._snapshots.keep_s
        )
        takes_over = self._snapshots.clock() - self._opened_s < _TAKE_OVER_S
        try:
            epoch = await self._snapshots.save(saved, self.owner, takes_over=takes_over)
        except StoreUnavailable:
            return False
        except OwnedByOther:
            self._closed = True
            self._on_lost()
            return True
        self.owner = Owner(self.owner.name, epoch)
        self.saved_frame_id = max(self.saved_frame_id, snapshot.last_frame_id)
        self._written_s = self._snapshots.clock()
        return True

    async def _discard(self) -> None:
        if self._writing is not None:
            await asyncio.wait([self._writing])
        await self._snapshots.discard(self._key, self.owner)


class Snapshots:
    """The snapshots of one server, in ``store``.

    ``keep_s`` is how long a snapshot outlives the last write of its stream, and ``patience_s`` how
    long anybody waits for the store. ``clock`` returns seconds, and goes on while the server is
    suspended.
    """

    def __init__(
        self,
        store: SnapshotStore,
        *,
        keep_s: float,
        patience_s: float,
        threads: ThreadPool,
        clock: Callable[[], float],
        metrics: Metrics,
    ) -> None:
        self._store = store
        self.keep_s = keep_s
        self.patience_s = patience_s
        self.threads = threads
        self.clock = clock
        self._metrics = metrics
        self._tasks: set[asyncio.Task[None]] = set()
        self._failed_s: float | None = None  # the last call failed at this time

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        if self._tasks:
            await asyncio.wait(list(self._tasks), timeout=self.patience_s)
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self._store.close()

    def saver(
        self,
        key: str,
        *,
        token_digest: str,
        rig_digest: str,
        on_lost: Callable[[], None],
        owner: Owner | None = None,
    ) -> StreamSaver:
        """Make the writer of one stream. ``owner``: as it claimed a snapshot; None: a new one."""
        return StreamSaver(
            self,
            key,
            owner or new_owner(),
            token_digest=token_digest,
            rig_digest=rig_digest,
            on_lost=on_lost,
        )

    async def claim(
        self, key: str, owner: Owner, *, token_digest: str, rig_digest: str
    ) -> tuple[Owner, StreamSnapshot] | Claim:
        """Become the owner of a stream's snapshot, and read it.

        A store that fails, or a damaged snapshot, counts as no snapshot.
        """
        if self._failed_s is not None and self.clock() - self._failed_s < _PAUSE_S:
            return Claim.UNKNOWN
        try:
            claimed = await self._store.claim(
                key, owner, token_digest=token_digest, rig_digest=rig_digest
            )
        except StoreUnavailable as error:
            self._note_failure(error)
            return Claim.UNKNOWN
        self._note_success()
        if not isinstance(claimed, Claimed):
            return claimed
        try:
            snapshot = await self.threads.run(StreamSnapshot.from_bytes, claimed.value)
        except BadSnapshot as error:
            log.warning("the snapshot of stream %s cannot be read: %s", key, error)
            return Claim.UNKNOWN
        return Owner(owner.name, claimed.epoch), snapshot

    async def save(self, saved: Saved, owner: Owner, *, takes_over: bool) -> int:
        """Write a value; see :class:`SnapshotStore`. Counts and logs what fails."""
        try:
            epoch = await self._store.save(saved, owner, takes_over=takes_over)
        except StoreUnavailable as error:
            self._note_failure(error)
            raise
        except OwnedByOther:
            self._metrics.snapshots.labels("superseded").inc()
            raise
        self._note_success()
        self._metrics.snapshots.labels("saved").inc()
        self._metrics.snapshot_bytes.inc(len(saved.value))
        return epoch

    async def discard(self, key: str, owner: Owner) -> None:
        """Remove a value. If the store fails, it expires there."""
        try:
            await self._store.discard(key, owner)
        except StoreUnavailable as error:
            self._note_failure(error)

    def start(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Run work that ends before the server does."""
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    def _note_failure(self, error: StoreUnavailable) -> None:
        self._metrics.snapshots.labels("failed").inc()
        if self._failed_s is None:
            log.warning(
                "snapshots of streams cannot be stored: %s. Streams go on, but cannot move to "
                "another server with their state",
                error,
            )
        self._failed_s = self.clock()

    def _note_success(self) -> None:
        if self._failed_s is not None:
            self._failed_s = None
            log.warning("snapshots of streams are stored again")


def new_owner() -> Owner:
    """Return an owner that the store does not know yet."""
    return Owner(secrets.token_hex(16))
