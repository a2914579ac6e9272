"""The snapshots of streams that the settings ask for."""

import time

from vergence_service.process.metrics import Metrics
from vergence_service.process.threads import Threads
from vergence_service.settings import Settings
from vergence_service.snapshots.saver import Snapshots
from vergence_service.transports.errors import ExtraMissing


def make_snapshots(settings: Settings, threads: Threads, *, metrics: Metrics) -> Snapshots | None:
    """Make the snapshots of a server; None: it keeps none. Raises ExtraMissing."""
    if settings.snapshots.store == "none":
        return None
    try:
        from vergence_service.snapshots.redis_store import RedisStore
    except ModuleNotFoundError:
        raise ExtraMissing("Redis", "fleet") from None
    return Snapshots(
        RedisStore(settings.snapshots.store, timeout_s=settings.snapshots.timeout_s),
        # A stream that is open here may be silent for this long.
        keep_s=settings.streams.idle_timeout_s + settings.streams.detach_grace_s,
        patience_s=settings.snapshots.timeout_s,
        threads=threads.background,
        clock=time.monotonic,
        metrics=metrics,
    )
