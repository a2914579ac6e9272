"""The metrics of the server, for Prometheus."""

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram

from vergence_proto.errors import ErrorCode

_STAGE_BUCKETS_S = (
    *(0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.033, 0.05, 0.1, 0.2, 0.5),
    *(1.0, 2.0, 5.0, 10.0),
)
_SEQUENCE_BUCKETS_S = (0.1, 0.5, 1, 5, 10, 30, 60, 300, 600, 1800, 3600, 7200)


class Metrics:
    """All metrics of one server, in ``registry``."""

    def __init__(self, registry: CollectorRegistry) -> None:
        self.frames_stepped = Counter(
            "vergence_frames_stepped",
            "Frames answered with a disparity map",
            ["origin"],
            registry=registry,
        )
        self.frames_dropped = Counter(
            "vergence_frames_dropped",
            "Frames that were displaced by a newer frame",
            registry=registry,
        )
        self.frames_failed = Counter(
            "vergence_frames_failed",
            "Frames that were answered with an error",
            ["reason"],
            registry=registry,
        )
        for code in ErrorCode:  # a rate needs a series from the start
            self.frames_failed.labels(code)
        self.frame_age_s = Histogram(
            "vergence_frame_age_seconds",
            "Time from a frame's arrival to its answer",
            buckets=_STAGE_BUCKETS_S,
            registry=registry,
        )
        self.model_s = Counter(
            "vergence_model_seconds",
            "Time in the model",
            ["principal"],
            registry=registry,
        )
        self.turns_waiting = Gauge(
            "vergence_turns_waiting", "Live streams that wait for the model", registry=registry
        )
        self.openings = Counter(
            "vergence_openings", "Openings of streams", ["outcome"], registry=registry
        )
        for outcome in ("opened", "resumed", *ErrorCode):
            self.openings.labels(outcome)
        self.calls_ended = Counter(
            "vergence_calls_ended",
            "StreamDepth calls that have ended",
            ["transport", "reason"],
            registry=registry,
        )
        for transport in ("grpc", "http", "zenoh"):
            for reason in ("done", "lost", "left"):
                self.calls_ended.labels(transport, reason)
        self.streams_expired = Counter(
            "vergence_streams_expired", "Streams that have expired", ["why"], registry=registry
        )
        for why in ("idle", "detached"):
            self.streams_expired.labels(why)
        self.build_info = Gauge(
            "vergence_build_info",
            "1, with the versions as labels",
            ["version", "model", "weights", "engine", "provider"],
            registry=registry,
        )
        self.stage_s = Histogram(
            "vergence_stage_seconds",
            "Time that one frame spent in one stage",
            ["stage"],
            buckets=_STAGE_BUCKETS_S,
            registry=registry,
        )
        self.batch_size = Histogram(
            "vergence_batch_size",
            "Frames that the model stepped together",
            buckets=(1, 2, 4, 8, 16, 32),
            registry=registry,
        )
        self.decoder_messages = Counter(
            "vergence_decoder_messages",
            "Lines that image decoders wrote about damaged images",
            ["decoder"],
            registry=registry,
        )
        for decoder in ("jpeg", "png"):
            self.decoder_messages.labels(decoder)
        self.streams_open = Gauge("vergence_streams_open", "Open streams", registry=registry)
        self.streams_opened = Counter(
            "vergence_streams_opened", "Streams that were opened", registry=registry
        )
        self.streams_closed = Counter(
            "vergence_streams_closed", "Streams that were closed or have expired", registry=registry
        )
        self.snapshots = Counter(
            "vergence_snapshots",
            "Writes of stream snapshots, and other calls of their store that failed",
            ["outcome"],
            registry=registry,
        )
        for outcome in ("saved", "failed", "superseded"):
            self.snapshots.labels(outcome)
        self.snapshot_bytes = Counter(
            "vergence_snapshot_bytes", "Bytes of the snapshots that were stored", registry=registry
        )
        self.calls_open = Gauge(
            "vergence_calls_open", "StreamDepth calls that have not ended", registry=registry
        )
        self.streams_predicted = Gauge(
            "vergence_streams_predicted",
            "Live streams whose next frame is predicted",
            registry=registry,
        )
        self.memory_bytes = Gauge(
            "vergence_memory_bytes",
            "Memory reserved for streams",
            ["kind"],
            registry=registry,
        )
        self.memory_limit_bytes = Gauge(
            "vergence_memory_limit_bytes", "Limit of all kinds together", registry=registry
        )
        self.pairs = Gauge(
            "vergence_pairs", "Single pairs that wait or are stepped", registry=registry
        )
        self.sequences = Gauge(
            "vergence_sequences",
            "Accepted sequences that wait or run",
            ["state"],
            registry=registry,
        )
        self.sequences_done = Counter(
            "vergence_sequences_done", "Sequences that succeeded", registry=registry
        )
        self.sequences_failed = Counter(
            "vergence_sequences_failed", "Sequences that failed", ["reason"], registry=registry
        )
        self.sequence_frames = Counter(
            "vergence_sequence_frames",
            "Frames of sequences whose result was written",
            registry=registry,
        )
        self.sequence_frames_failed = Counter(
            "vergence_sequence_frames_failed",
            "Frames of sequences that have no result, because they could not be read or stepped",
            registry=registry,
        )
        self.sequences_refused = Counter(
            "vergence_sequences_refused",
            "Uploads that were refused because the disk has no room beside results",
            registry=registry,
        )
        self.sequence_s = Histogram(
            "vergence_sequence_seconds",
            "Time of one run of a sequence",
            buckets=_SEQUENCE_BUCKETS_S,
            registry=registry,
        )
        self.sequence_disk_bytes = Gauge(
            "vergence_sequence_disk_bytes",
            "Disk space that sequences use or have reserved",
            registry=registry,
        )
