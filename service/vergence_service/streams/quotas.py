"""What one principal, or one address, may hold of a server."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from vergence_proto.errors import Quota
from vergence_service.access.principals import Principal
from vergence_service.process.memory import StreamMemory
from vergence_service.streams.stream import Stream

_MIB = 1 << 20
# What a stream has used lately says how much it uses.
_LATELY_S = 5.0
_NAMED = 3  # streams in a message


@dataclass(frozen=True, slots=True)
class User:
    """Whose a connection or an opening is, and the bytes that it holds."""

    owner: str
    client: str
    nbytes: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Quotas:
    """The limits of a principal that has shown a credential, and of an address. None: no limit."""

    streams: int | None = None  # open at once
    state_bytes: int | None = None  # of all its streams
    megapixels_per_s: float | None = None  # of the images that were stepped, left and right
    streams_per_client: int | None = None  # open streams of one address

    def check(
        self,
        owner: Principal,
        client: str,
        need: StreamMemory,
        *,
        streams: Sequence[Stream],
        others: Sequence[User],
        now_s: float,
        next_expiry_s: Callable[[Sequence[Stream]], float],
    ) -> None:
        """Raise Quota if another stream would be above a limit of its owner or its address.

        ``streams`` are those of the server, ``others`` are places that are taken without one.
        ``next_expiry_s`` returns when the first of some streams expires, in seconds from now.
        """
        if owner.proven:
            mine = [each for each in streams if each.owner.name == owner.name]
            reserved = [each for each in others if each.owner == owner.name]
            room_in_s = next_expiry_s(mine)
            self._check_count(owner, mine, len(reserved), room_in_s)
            self._check_memory(owner, need, mine, reserved, room_in_s)
            self._check_pixels(owner, mine, now_s)
        if not client or self.streams_per_client is None:
            return
        here = [each for each in streams if each.client == client]
        count = len(here) + sum(each.client == client for each in others)
        if count >= self.streams_per_client:
            raise Quota(
                f"{client} has {count} open streams, the limit per client; close one, or "
                "try again later (the server's setting limits.streams_per_client)",
                retry_after_s=next_expiry_s(here),
            )

    def _check_count(
        self, owner: Principal, mine: Sequence[Stream], reserved: int, room_in_s: float
    ) -> None:
        count = len(mine) + reserved
        most = owner.streams or self.streams
        if most is not None and count >= most:
            raise Quota(
                f"{owner.name} has {count} open streams{_named(mine)}, the limit of one principal; "
                "close one, or try again later (the server's setting limits.streams)",
                retry_after_s=room_in_s,
            )

    def _check_memory(
        self,
        owner: Principal,
        need: StreamMemory,
        mine: Sequence[Stream],
        reserved: Sequence[User],
        room_in_s: float,
    ) -> None:
        held = sum(each.memory.nbytes for each in mine) + sum(each.nbytes for each in reserved)
        if self.state_bytes is not None and held + need.own > self.state_bytes:
            raise Quota(
                f"{owner.name} holds {held / _MIB:.1f} MiB{_named(mine)}, and the stream needs "
                f"{need.own / _MIB:.1f} MiB more; the limit of one principal is "
                f"{self.state_bytes / _MIB:.0f} MiB; close a stream, or send smaller images (the "
                "server's setting limits.state_mib)",
                retry_after_s=room_in_s,
            )

    def _check_pixels(self, owner: Principal, mine: Sequence[Stream], now_s: float) -> None:
        if self.megapixels_per_s is None:
            return
        used = sum(megapixels_per_s(each, now_s) for each in mine)
        if used >= self.megapixels_per_s:
            raise Quota(
                f"{owner.name} uses {used:.1f} megapixels per second{_named(mine)}, and the limit "
                f"of one principal is {self.megapixels_per_s:g}; reduce the rate or the size of "
                "its images, or close a stream (the server's setting limits.megapixels_per_s)",
                retry_after_s=_LATELY_S,
            )


def megapixels_per_s(stream: Stream, now_s: float) -> float:
    """Return how much was stepped for a stream lately, left and right images together."""
    rig = stream.rectifier.rig
    frames = sum(now_s - done_s <= _LATELY_S for done_s, _ in stream.answers)
    return 2e-6 * rig.width * rig.height * frames / _LATELY_S


def _named(streams: Sequence[Stream]) -> str:
    """Return the largest streams in words."""
    names = []
    for stream in sorted(streams, key=lambda each: -each.memory.nbytes)[:_NAMED]:
        rig = stream.rectifier.rig
        names.append(f"{stream.stream_id} {rig.width}x{rig.height}")
    more = ", ..." if len(streams) > _NAMED else ""
    return f" ({', '.join(names)}{more})" if names else ""
