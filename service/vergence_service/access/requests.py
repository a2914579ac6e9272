"""The requests of each principal that are open, over gRPC and HTTP."""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

from vergence_proto.errors import Quota
from vergence_service.access.principals import Principal


class OpenRequests:
    """Counts open requests, and refuses those above ``most`` of one principal; None: no limit.

    Callers without a credential share a name, so they have no limit.
    """

    def __init__(self, most: int | None) -> None:
        self._most = most
        self._open: Counter[str] = Counter()

    @contextmanager
    def of(self, caller: Principal) -> Iterator[None]:
        """Count a request of ``caller`` that lasts as long as the block. Raises Quota."""
        if not caller.proven:
            yield
            return
        count = self._open[caller.name]
        if self._most is not None and count >= self._most:
            raise Quota(
                f"{caller.name} has {count} open calls and requests, the limit of one principal; "
                "end some, or try again later (the server's setting limits.requests)",
                retry_after_s=1.0,
            )
        self._open[caller.name] += 1
        try:
            yield
        finally:
            self._open[caller.name] -= 1
            if not self._open[caller.name]:
                del self._open[caller.name]
