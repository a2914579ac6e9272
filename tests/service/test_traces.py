"""Every frame of a stream is a span at a collector, below the span of its client."""

import asyncio
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest
from opentelemetry.proto.trace.v1.trace_pb2 import Span

from tests.support.frames import frame_message, make_frame, open_message
from tests.support.models import RecallModel
from tests.support.server import RawCall, connected, running_server

PARENT = "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01"


@asynccontextmanager
async def collector(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[list[Span]]:
    """What OpenTelemetry's exporter sends by OTLP over HTTP."""
    spans: list[Span] = []

    async def receive(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = (await reader.readuntil(b"\r\n\r\n")).decode().lower()
        assert "content-type: application/x-protobuf" in head
        size = int(head.partition("content-length:")[2].split()[0])
        request = ExportTraceServiceRequest.FromString(await reader.readexactly(size))
        for resource in request.resource_spans:
            for scope in resource.scope_spans:
                spans.extend(scope.spans)
        writer.write(b"HTTP/1.1 200 OK\r\ncontent-length: 0\r\nconnection: close\r\n\r\n")
        await writer.drain()
        writer.close()

    async with await asyncio.start_server(receive, "127.0.0.1", 0) as server:
        host, port = server.sockets[0].getsockname()
        monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", f"http://{host}:{port}")
        monkeypatch.setenv("OTEL_EXPORTER_OTLP_COMPRESSION", "none")
        yield spans


async def test_a_frame_is_a_span_with_its_stages_below_the_span_of_its_client(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with collector(monkeypatch) as spans:
        async with (
            running_server(RecallModel(), server__traces=True) as server,
            connected(server) as calls,
        ):
            call = RawCall(calls.StreamDepth(metadata=(("traceparent", PARENT),)))
            await call.ask(open_message("headset-1"))
            for frame_id in (1, 2):
                await call.ask(frame_message(make_frame(frame_id)))
            call.call.cancel()
            assert [each for each in threading.enumerate() if each.name.startswith("Otel")]
        frames = [each for each in spans if each.name == "frame"]
        assert len(frames) == 2
        for number, frame in enumerate(frames, 1):
            assert frame.trace_id.hex() == PARENT[3:35]
            assert frame.parent_span_id.hex() == PARENT[36:52]
            about = {each.key: each.value for each in frame.attributes}
            assert about["vergence.stream"].string_value == "headset-1"
            assert about["vergence.frame_id"].int_value == number
            assert about["vergence.origin"].string_value == (
                "cold_start" if number == 1 else "warm"
            )
            stages = {each.name: each for each in spans if each.parent_span_id == frame.span_id}
            assert set(stages) == {"queue", "decode", "model"}
            assert (
                stages["queue"].end_time_unix_nano
                == stages["decode"].start_time_unix_nano
                <= stages["model"].start_time_unix_nano
                <= stages["model"].end_time_unix_nano
                == frame.end_time_unix_nano
            )
    assert not [each for each in threading.enumerate() if each.name.startswith("Otel")]
