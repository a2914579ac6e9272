"""Resume a stream: as this server has it, or from the snapshot that another server wrote."""

import asyncio
from collections.abc import Awaitable, Callable
from weakref import WeakValueDictionary

from vergence_proto.errors import (
    BadCalibration,
    ModelChanged,
    StreamExists,
    Superseded,
)
from vergence_proto.types import Origin, StereoRig
from vergence_service.access.principals import Principal
from vergence_service.process.memory import StreamMemory
from vergence_service.snapshots.saver import Snapshots, new_owner
from vergence_service.snapshots.snapshot import (
    StreamSnapshot,
    digest_of_rig,
    digest_of_token,
)
from vergence_service.snapshots.store import Claim, Owner
from vergence_service.streams.conversion import SteppedFrame
from vergence_service.streams.rectify import Rectifier
from vergence_service.streams.stream import Attachment, Stream, StreamConfig, key_of
from vergence_service.streams.table import StreamTable


class StreamResumer:
    """Resumes the streams of ``streams``, and lets other servers resume them.

    ``snapshots`` None: only this server can resume a stream.
    """

    def __init__(
        self,
        streams: StreamTable,
        snapshots: Snapshots | None,
        *,
        weights_sha256: str,
        memory_of: Callable[[StreamConfig], Awaitable[StreamMemory]],
        rectifier_of: Callable[[StereoRig], Awaitable[Rectifier]],
    ) -> None:
        self._streams = streams
        self._snapshots = snapshots
        self._weights_sha256 = weights_sha256
        self._memory_of = memory_of
        self._rectifier_of = rectifier_of
        # Of each stream that is being resumed: two connections must not both restore it.
        self._turns: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()

    @property
    def keeps_snapshots(self) -> bool:
        """True if other servers can resume the streams of this one."""
        return self._snapshots is not None

    def keep(self, stream: Stream, *, owner: Owner | None = None) -> None:
        """Keep snapshots of a stream that was opened, if the server keeps any."""
        if self._snapshots is not None:
            stream.saver = self._snapshots.saver(
                stream.key,
                token_digest=digest_of_token(stream.resume_token),
                rig_digest=digest_of_rig(stream.config.rig),
                on_lost=lambda: self._end_superseded(stream),
                owner=owner,
            )
            self.save(stream)

    def save(self, stream: Stream) -> None:
        """Write a snapshot of the stream as it is, soon."""
        if stream.saver is not None:
            snapshot = StreamSnapshot(
                stream.last_frame_id, self._weights_sha256, stream.origin, stream.state
            )
            stream.saver.put(snapshot, now=True)

    def save_after(self, stepped: SteppedFrame) -> None:
        """Write a snapshot of the stream as it was after this frame, soon."""
        saver, state = stepped.stream.saver, stepped.result.state
        if saver is not None:
            saver.put(
                StreamSnapshot(
                    stepped.frame_id,
                    self._weights_sha256,
                    Origin.WARM if state.tensors else Origin.COLD_START,
                    state if state.tensors else None,
                )
            )

    async def resume(
        self,
        stream_id: str,
        resume_token: bytes,
        config: StreamConfig,
        *,
        attachment: Attachment,
        client: str,
        owner: Principal,
    ) -> Stream:
        """Attach a connection to a stream; raises as the engine does."""

        def attach() -> Stream:
            return self._streams.attach(
                stream_id, resume_token, config, attachment=attachment, client=client, owner=owner
            )

        if self._snapshots is None:
            return attach()
        key = key_of(owner.name, stream_id)
        async with self._turns.setdefault(key, asyncio.Lock()):
            local = self._streams.find(key)
            # Even a stream that is open here may be older than its snapshot: if this server was
            # suspended or cut off, another one may have had the stream meanwhile.
            known = local.saver.owner if local is not None and local.saver else new_owner()
            found = await self._snapshots.claim(
                key,
                known,
                token_digest=digest_of_token(resume_token),
                rig_digest=digest_of_rig(config.rig),
            )
            if isinstance(found, Claim):
                if local is None and found is Claim.WRONG_TOKEN:
                    raise StreamExists(f"stream {stream_id!r} is open, and the token is wrong")
                if local is None and found is Claim.OTHER_RIG:
                    raise BadCalibration(
                        f"stream {stream_id!r} was opened with another rig; open a new stream"
                    )
                return attach()  # or raises the reason why the stream is gone
            store_owner, snapshot = found
            if local is not None and local.last_frame_id > snapshot.last_frame_id:
                if local.saver is not None:
                    local.saver.owner = store_owner
                return attach()
            if snapshot.weights_sha256 != self._weights_sha256:
                raise ModelChanged(
                    f"the state of stream {stream_id!r} belongs to weights "
                    f"{snapshot.weights_sha256[:12]}, and this server runs "
                    f"{self._weights_sha256[:12]}; open a new stream"
                )
            if local is not None:
                self._end_superseded(local)
            need = await self._memory_of(config)
            with self._streams.reserve(stream_id, need, client=client, owner=owner) as place:
                rectifier = await self._rectifier_of(config.rig)
                stream = self._streams.open(
                    place, config, rectifier, attachment=attachment, resume_token=resume_token
                )
            _restore(stream, snapshot)
            self.keep(stream, owner=store_owner)
            return stream

    def left(self, stream: Stream) -> None:
        """Write the newest snapshot now, even a large one: the client may go to another server."""
        if stream.saver is not None:
            stream.saver.write_now()

    async def flush(self, stream: Stream) -> None:
        """Write the newest snapshot of a stream that another server may resume at once."""
        if stream.saver is not None:
            await stream.saver.flush()

    def _end_superseded(self, stream: Stream) -> None:
        """End a stream that another server has, without its snapshot."""
        stream.saver = None
        self._streams.close(stream)
        if stream.attachment is not None:
            stream.attachment.end(
                Superseded(f"another server has taken stream {stream.stream_id!r} over")
            )


def _restore(stream: Stream, snapshot: StreamSnapshot) -> None:
    stream.last_frame_id = snapshot.last_frame_id
    stream.origin = snapshot.origin
    # Another rectification, by other settings of this server, has another image size.
    if snapshot.state is not None and snapshot.state.rig == stream.rectifier.window.rig:
        stream.state = snapshot.state
        stream.origin = Origin.RESUMED
