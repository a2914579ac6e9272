"""What the server counts, for Prometheus."""

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram

_STAGE_BUCKETS_S = (0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.033, 0.05, 0.1, 0.2, 0.5, 1.0)


class Metrics:
    """All counters of one server, in the registry given."""

    def __init__(self, registry: CollectorRegistry) -> None:
        self.frames_stepped = Counter(
            "vergence_frames_stepped", "Frames answered with a map", ["origin"], registry=registry
        )
        self.frames_dropped = Counter(
            "vergence_frames_dropped", "Frames displaced by a newer one", registry=registry
        )
        self.frames_failed = Counter(
            "vergence_frames_failed", "Frames answered with an error", ["reason"], registry=registry
        )
        self.stage_s = Histogram(
            "vergence_stage_seconds",
            "Time of one frame in one stage",
            ["stage"],
            buckets=_STAGE_BUCKETS_S,
            registry=registry,
        )
        self.batch_size = Histogram(
            "vergence_batch_size",
            "Streams stepped together",
            buckets=(1, 2, 4, 8, 16, 32),
            registry=registry,
        )
        self.streams_open = Gauge(
            "vergence_streams_open", "Streams with a state", registry=registry
        )
        self.state_bytes = Gauge(
            "vergence_state_bytes", "Memory reserved for states", registry=registry
        )
