"""What an administrator sees of the open streams."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median

from prometheus_client import Counter, Gauge
from prometheus_client.samples import Sample

from vergence_service.process.memory import MemoryKind
from vergence_service.streams.engine import DepthEngine
from vergence_service.streams.quotas import megapixels_per_s
from vergence_service.streams.stream import Stream
from vergence_service.streams.table import StreamTable

# The rate is that of the last seconds.
_RATE_S = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamReport:
    """One open stream."""

    principal: str
    stream_id: str
    transport: str  # grpc, http or zenoh
    address: str  # of the client; over Zenoh without a token "zenoh"; empty: not known
    attached: bool
    delivery: str
    width: int
    height: int
    rate_hz: float  # answers a second
    age_p50_s: float | None  # from a frame's arrival to the end of its step
    model_s: float  # time in the model, of all its frames
    last_origin: str | None  # why the last step was warm or cold
    last_iterations: int  # of the last step; 0: there was none
    warm_steps: int  # steps since the last cold start
    frames_stepped: int
    frames_dropped: int
    frames_failed: int
    failures: dict[str, int]  # failed frames, by reason
    idle_s: float
    state_bytes: int


@dataclass(frozen=True, slots=True, kw_only=True)
class PrincipalReport:
    """What one principal uses."""

    principal: str
    streams: int
    model_s: float  # time in the model since the server started
    megapixels_per_s: float  # stepped lately, left and right images together
    memory_bytes: int  # of its streams, without steps


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerReport:
    """The server as a whole. Counts are since it started."""

    at_s: float  # time of the report, of a clock that only goes forward
    health: str  # loading, serving or draining
    version: str
    model: str
    weights: str
    engine: str
    provider: str
    lanes: int  # steps that the model can take side by side
    turns_waiting: int  # live streams that wait for the model
    calls_open: int
    memory_bytes: dict[str, int]  # by kind
    memory_limit_bytes: int
    sequences: dict[str, int]  # waiting and running ones
    refusals: dict[str, dict[str, int]]  # by what was refused or ended, and why
    principals: list[PrincipalReport]


def server_report(engine: DepthEngine, now_s: float) -> ServerReport:
    """Return what an administrator sees of the server, those who use the model most first."""
    metrics = engine.metrics
    streams = list(engine.streams)
    model_s = _by_label(metrics.model_s, "principal")
    names = {*model_s, *(each.owner.name for each in streams)}
    principals = [
        _principal(name, [each for each in streams if each.owner.name == name], model_s, now_s)
        for name in names
    ]
    [build] = _labels(metrics.build_info) or [{}]
    openings = _counts(metrics.openings, "outcome")
    refused = {why: count for why, count in openings.items() if why not in ("opened", "resumed")}
    ended = _counts(metrics.calls_ended, "reason")
    return ServerReport(
        at_s=now_s,
        health=engine.health,
        version=build.get("version", ""),
        model=engine.card.name,
        weights=engine.card.weights_sha256[:12],
        engine=engine.computed_by,
        provider=engine.provider,
        lanes=engine.lanes,
        turns_waiting=len(engine.turns),
        calls_open=int(sum(_values(metrics.calls_open))),
        memory_bytes={kind: engine.memory.used(kind) for kind in MemoryKind},
        memory_limit_bytes=int(sum(_values(metrics.memory_limit_bytes))),
        sequences=_counts(metrics.sequences, "state"),
        refusals={
            "opening refused": refused,
            "call ended": {why: count for why, count in ended.items() if why != "done"},
            "stream expired": _counts(metrics.streams_expired, "why"),
            "frame failed": _counts(metrics.frames_failed, "reason"),
            "sequence failed": _counts(metrics.sequences_failed, "reason"),
        },
        principals=sorted(principals, key=lambda each: -each.model_s),
    )


def _principal(
    name: str, streams: Sequence[Stream], model_s: Mapping[str, float], now_s: float
) -> PrincipalReport:
    return PrincipalReport(
        principal=name,
        streams=len(streams),
        model_s=round(model_s.get(name, 0.0), 3),
        megapixels_per_s=round(sum(megapixels_per_s(each, now_s) for each in streams), 2),
        memory_bytes=sum(each.memory.nbytes for each in streams),
    )


def _by_label(metric: Counter | Gauge, label: str) -> dict[str, float]:
    """Return the sums of a metric by one of its labels."""
    sums: dict[str, float] = {}
    for sample in _samples(metric):
        name = sample.labels[label]
        sums[name] = sums.get(name, 0.0) + sample.value
    return sums


def _counts(metric: Counter | Gauge, label: str) -> dict[str, int]:
    """Return the same as integers, without zeros."""
    return {name: int(value) for name, value in _by_label(metric, label).items() if value}


def _labels(metric: Counter | Gauge) -> list[dict[str, str]]:
    return [sample.labels for sample in _samples(metric)]


def _values(metric: Counter | Gauge) -> list[float]:
    return [sample.value for sample in _samples(metric)]


def _samples(metric: Counter | Gauge) -> list[Sample]:
    """Return the current values; those of when counting began are left out."""
    [family] = metric.collect()
    return [sample for sample in family.samples if not sample.name.endswith("_created")]


def reports(table: StreamTable, now_s: float) -> list[StreamReport]:
    """Return all open streams, those with the most time in the model first."""
    return sorted((_report(each, table, now_s) for each in table), key=lambda each: -each.model_s)


def _report(stream: Stream, table: StreamTable, now_s: float) -> StreamReport:
    lately = [age_s for done_s, age_s in stream.answers if now_s - done_s <= _RATE_S]
    since_s = min((done_s for done_s, _ in stream.answers if now_s - done_s <= _RATE_S), default=0)
    rig = stream.rectifier.rig
    return StreamReport(
        principal=stream.owner.name,
        stream_id=stream.stream_id,
        transport=stream.transport,
        address=stream.client,
        attached=stream.attachment is not None,
        delivery=stream.config.delivery.name.lower(),
        width=rig.width,
        height=rig.height,
        rate_hz=round((len(lately) - 1) / max(now_s - since_s, 1e-3), 2) if lately else 0.0,
        age_p50_s=round(median(lately), 4) if lately else None,
        model_s=round(stream.model_s, 3),
        last_origin=stream.last_origin.name.lower() if stream.last_origin else None,
        last_iterations=stream.last_iterations,
        warm_steps=stream.state.step_count - 1 if stream.state else 0,
        frames_stepped=stream.frames_stepped,
        frames_dropped=stream.frames_dropped,
        frames_failed=stream.frames_failed,
        failures={str(code): count for code, count in stream.failures.items()},
        idle_s=round(table.idle_s(stream), 1),
        state_bytes=stream.state.nbytes if stream.state else 0,
    )
