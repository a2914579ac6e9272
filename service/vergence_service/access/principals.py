"""A principal: the owner of streams and jobs, and what it proved about itself."""

import re
from dataclasses import dataclass
from enum import StrEnum

from vergence_proto.errors import Forbidden

# Names are parts of Zenoh's keys and values of metrics.
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_RESERVED = {"local", "server"}


class Role(StrEnum):
    """What a principal may do."""

    USER = "user"  # use its own streams and jobs
    ADMIN = "admin"  # see and end those of all


@dataclass(frozen=True, slots=True)
class Principal:
    """The sender of a request."""

    name: str
    role: Role = Role.USER
    # Digest of the token, or name of the certificate, that it showed. Without one, all callers
    # share a name, and a stream obeys only those who know its resume token.
    credential: str = ""
    streams: int | None = None  # most open streams, in place of the server's limit
    weight: float = 1.0  # share of the machine, relative to other principals

    @property
    def proven(self) -> bool:
        """True if the caller showed a credential."""
        return bool(self.credential)

    def owns(self, owner: str) -> bool:
        """Return True if the caller may use what belongs to the principal ``owner``."""
        return owner == self.name or self.role is Role.ADMIN

    def check_admin(self) -> None:
        """Raise Forbidden unless the caller is an administrator."""
        if self.role is not Role.ADMIN:
            raise Forbidden("this needs the token of an administrator: vergence token add --role")


# Every caller of a server that asks for no credential.
LOCAL = Principal("local")


def checked_name(name: str) -> str:
    """Return ``name``; raise ValueError if it is no name of a principal."""
    if not _NAME.fullmatch(name) or name in _RESERVED:
        raise ValueError(
            f"expected 1 to 64 characters of [A-Za-z0-9._-], not {' or '.join(sorted(_RESERVED))}, "
            f"got {name!r}"
        )
    return name
