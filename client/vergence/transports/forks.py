"""Detection of processes that were forked while gRPC was in use, in which it cannot work."""

import gc
import os
from weakref import WeakSet

from vergence.transports.base import ConnectionLost

FORKED = (
    "this process was forked while a Vergence client was open, and connections do not survive a "
    "fork; start processes with multiprocessing.get_context('spawn'), or open clients after it"
)

_alive: WeakSet[object] = WeakSet()  # channels and calls: gRPC's threads run as long as one exists
_forked_while_alive = False


def check_not_forked() -> None:
    """Raise ConnectionLost if gRPC cannot work in this process."""
    if _forked_while_alive:
        raise ConnectionLost(FORKED)


def watch(used: object) -> None:
    """Record a channel or a call. A process that is forked while it exists is told."""
    _alive.add(used)


def _before_fork() -> None:
    if _alive:
        gc.collect()  # a call that has ended is part of a cycle


def _after_fork() -> None:
    global _forked_while_alive
    _forked_while_alive = _forked_while_alive or len(_alive) > 0


if hasattr(os, "register_at_fork"):  # Windows has no fork
    os.register_at_fork(before=_before_fork, after_in_child=_after_fork)
