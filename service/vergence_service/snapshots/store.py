"""The interface of a store of snapshots, outside of the server."""

from dataclasses import dataclass
from enum import Enum
from typing import Protocol


class StoreUnavailable(Exception):
    """The store did not answer in time, or refused."""


class OwnedByOther(Exception):
    """A newer owner has the stream: another server resumed it, or a client opened it again."""


@dataclass(frozen=True, slots=True)
class Owner:
    """One stream on one server.

    ``epoch`` orders the owners of one key in time: the newest is the highest. 0: not known yet,
    because the store has not confirmed anything of this owner.
    """

    name: str  # random
    epoch: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Saved:
    """One value for the store."""

    key: str
    value: bytes
    token_digest: str
    rig_digest: str
    keep_s: float  # the store discards the value so long after the last write


class Claim(Enum):
    """The outcome of a claim that gave no snapshot."""

    OURS = "the caller is the owner already"
    UNKNOWN = "there is no such snapshot"
    WRONG_TOKEN = "the token is another one"
    OTHER_RIG = "the stream has another rig"


@dataclass(frozen=True, slots=True, eq=False)
class Claimed:
    """A snapshot whose owner is now the caller, with this epoch."""

    epoch: int
    value: bytes


class SnapshotStore(Protocol):
    """Keeps one value for each key, and lets only its newest owner write it.

    Every method raises StoreUnavailable.
    """

    async def save(self, saved: Saved, owner: Owner, *, takes_over: bool) -> int:
        """Write a value and return the owner's epoch.

        ``takes_over``: an owner without an epoch becomes the newest, because its stream was opened
        just now. Otherwise it is only the first one. Raises OwnedByOther.
        """
        ...

    async def claim(
        self, key: str, owner: Owner, *, token_digest: str, rig_digest: str
    ) -> Claimed | Claim:
        """Become the owner of a snapshot and read it: no earlier owner can write it any more."""
        ...

    async def discard(self, key: str, owner: Owner) -> None:
        """Remove the value if ``owner`` still owns it."""
        ...

    async def close(self) -> None:
        """Close the connections."""
        ...
