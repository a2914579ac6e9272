"""OpenTelemetry: a span for every frame, below that of the client that opened the stream.

Where spans go is for the environment to say, as everywhere: ``OTEL_EXPORTER_OTLP_ENDPOINT`` and the
other variables of OpenTelemetry.
"""

import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from opentelemetry import trace
from opentelemetry.context import Context
from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
from opentelemetry.sdk.resources import SERVICE_NAME, Resource
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import BatchSpanProcessor

from vergence_service.streams.conversion import SteppedFrame
from vergence_service.streams.engine import DepthEngine
from vergence_service.streams.stream import TraceParent


class SpanPerFrame:
    """Makes the spans; a thread of OpenTelemetry sends them, and drops what is too many."""

    def __init__(self, provider: TracerProvider) -> None:
        self._tracer = provider.get_tracer("vergence")

    def add(self, frame: SteppedFrame, *, age_s: float) -> None:
        """Record a frame, and its stages one after the other, back from now."""
        stream, timings = frame.stream, frame.timings
        ended_ns = time.time_ns()
        span = self._tracer.start_span(
            "frame",
            _below(stream.trace_parent),
            kind=trace.SpanKind.SERVER,
            start_time=ended_ns - round(1e9 * age_s),
            attributes={
                "vergence.stream": stream.stream_id,
                "vergence.principal": stream.owner.name,
                "vergence.transport": stream.transport,
                "vergence.frame_id": frame.frame_id,
                "vergence.origin": frame.origin.name.lower(),
                "vergence.iterations": frame.iterations,
                "vergence.frames_skipped": frame.frames_skipped,
            },
        )
        below, until_ns = trace.set_span_in_context(span), ended_ns
        for stage in ("model", "decode", "queue"):
            begun_ns = until_ns - round(1e9 * getattr(timings, f"{stage}_s"))
            self._tracer.start_span(stage, below, start_time=begun_ns).end(until_ns)
            until_ns = begun_ns
        span.end(ended_ns)


@asynccontextmanager
async def span_per_frame(engine: DepthEngine) -> AsyncIterator[None]:
    """Export spans until the end of the block, which sends what is left."""
    provider = TracerProvider(resource=Resource.create({SERVICE_NAME: "vergence"}))
    provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter()))
    engine.traces = SpanPerFrame(provider)
    try:
        yield
    finally:
        engine.traces = None
        await engine.threads.background.run(provider.shutdown)


def _below(parent: TraceParent | None) -> Context | None:
    if parent is None:
        return None
    context = trace.SpanContext(
        int(parent.trace_id, 16),
        int(parent.span_id, 16),
        is_remote=True,
        trace_flags=trace.TraceFlags(int(parent.flags, 16)),
    )
    return trace.set_span_in_context(trace.NonRecordingSpan(context))
