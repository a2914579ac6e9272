"""The figures of a run: what counts as usual, and what is the first frame's own."""

import io

import pytest
from rich.console import Console

from vergence.cli.report import Report


def report_of(latencies_s: list[float]) -> Report:
    report = Report(seconds=1.0)
    for latency_s in latencies_s:
        report.add(latency_s, latency_s / 2, None)
    return report


def printed(report: Report) -> str:
    text = io.StringIO()
    Console(file=text, width=100).print(report.as_table("a run"))
    return text.getvalue()


def test_the_cold_first_frame_is_not_in_the_percentiles() -> None:
    report = report_of([5.0, *[0.1] * 3])
    figures = report.as_json()
    assert figures["latency_first_ms"] == pytest.approx(5000)
    assert figures["latency_p50_ms"] == figures["latency_p95_ms"] == pytest.approx(100)
    assert figures["frames"] == 4
    [model] = [line for line in printed(report).splitlines() if "model p50" in line]
    assert "50.0 ms" in model


def test_a_lone_frame_has_a_time_and_no_percentiles() -> None:
    table = printed(report_of([5.0]))
    assert "5000.0 ms" in table
    assert "latency p50" not in table


def test_a_run_without_answers_has_figures_too() -> None:
    assert report_of([]).as_json()["latency_p50_ms"] == 0
