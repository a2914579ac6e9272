"""Which server has a job: servers behind one front note it for one another."""

from collections.abc import Sequence
from typing import Protocol


class DirectoryUnavailable(Exception):
    """The directory did not answer in time, or refused."""


class JobDirectory(Protocol):
    """Maps the ids of jobs and uploads, and keys of submissions, to the address of their server.

    Every method raises DirectoryUnavailable.
    """

    async def note(self, names: Sequence[str], address: str) -> None:
        """Note that the server at ``address`` has these."""
        ...

    async def find(self, name: str) -> str | None:
        """Return the address of the server that has it; None: nobody has noted it."""
        ...

    async def close(self) -> None:
        """Close the connections."""
        ...
