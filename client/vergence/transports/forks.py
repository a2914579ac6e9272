"""Detection of processes that were forked after gRPC was used, in which it hangs or crashes."""

import os

from vergence.transports.base import ConnectionLost

FORKED = (
    "this process was forked after a Vergence client was opened, and gRPC does not survive a fork; "
    "start processes with multiprocessing.get_context('spawn'), open the first client after the "
    "fork, or use http://"
)

_used = False  # by this process or the one that it was forked from
_forked_after_use = False


def use_grpc() -> None:
    """Record that this process uses gRPC. Raises ConnectionLost: it cannot."""
    global _used
    if _forked_after_use:
        raise ConnectionLost(FORKED)
    _used = True


def _after_fork() -> None:
    global _forked_after_use
    _forked_after_use = _used


if hasattr(os, "register_at_fork"):  # Windows has no fork
    os.register_at_fork(after_in_child=_after_fork)
