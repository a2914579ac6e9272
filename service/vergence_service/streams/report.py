"""What an administrator sees of the open streams."""

from dataclasses import dataclass
from statistics import median

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
    address: str  # of the client; empty: not known
    attached: bool
    delivery: str
    width: int
    height: int
    rate_hz: float  # answers a second
    age_p50_s: float | None  # from a frame's arrival to the end of its step
    model_s: float  # time in the model, of all its frames
    last_origin: str | None  # why the last step was warm or cold
    warm_steps: int  # steps since the last cold start
    frames_stepped: int
    frames_dropped: int
    frames_failed: int
    idle_s: float
    state_bytes: int


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
        warm_steps=stream.state.step_count - 1 if stream.state else 0,
        frames_stepped=stream.frames_stepped,
        frames_dropped=stream.frames_dropped,
        frames_failed=stream.frames_failed,
        idle_s=round(table.idle_s(stream), 1),
        state_bytes=stream.state.nbytes if stream.state else 0,
    )
