"""Figures of a run: speed, and accuracy if there is ground truth."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from rich.table import Table

from vergence.results import Drops
from vergence_proto.accuracy import Accuracy


@dataclass(slots=True)
class Report:
    """Figures collected while frames come back; ``seconds`` is the duration of the run."""

    latencies_s: list[float] = field(default_factory=list)
    model_s: list[float] = field(default_factory=list)
    accuracies: list[Accuracy] = field(default_factory=list)
    seconds: float = 0.0
    drops: Drops = field(default_factory=Drops)
    kept_shares: list[float] = field(default_factory=list)
    """The share of each frame's values that filters kept."""
    frames_unread: int = 0
    """Frames of which a file could not be read."""

    def add(self, latency_s: float, model_s: float, accuracy: Accuracy | None) -> None:
        self.latencies_s.append(latency_s)
        self.model_s.append(model_s)
        if accuracy is not None:
            self.accuracies.append(accuracy)

    @property
    def accuracy(self) -> Accuracy | None:
        """The mean over the frames with ground truth; None if there are none."""
        mean = Accuracy.mean(self.accuracies)
        return mean if mean.n else None

    def as_json(self) -> Mapping[str, float | int | None]:
        """Return the keys that other programs read; accuracy is null without ground truth."""
        first_ms, p50_ms, p95_ms = _milliseconds(self.latencies_s)
        mean = self.accuracy
        return {
            "frames": len(self.latencies_s),
            "frames_dropped": self.drops.total,
            "frames_unread": self.frames_unread,
            "kept_pct": self.kept_pct,
            "fps": self.fps,
            "latency_first_ms": first_ms,
            "latency_p50_ms": p50_ms,
            "latency_p95_ms": p95_ms,
            "epe_px": mean.epe_px if mean else None,
            "d1_pct": mean.d1_pct if mean else None,
            "d3_pct": mean.d3_pct if mean else None,
        }

    @property
    def kept_pct(self) -> float:
        """The mean share of values that filters kept, in percent."""
        return 100 * float(np.mean(self.kept_shares)) if self.kept_shares else 100.0

    @property
    def fps(self) -> float:
        return len(self.latencies_s) / self.seconds if self.seconds > 0 else 0.0

    def as_table(self, title: str) -> Table:
        first_ms, p50_ms, p95_ms = _milliseconds(self.latencies_s)
        _, model_ms, _ = _milliseconds(self.model_s)
        table = Table(title=title, title_justify="left", show_header=False)
        table.add_column(style="bold")
        table.add_column(justify="right")
        table.add_column(style="dim")
        table.add_row("frames", str(len(self.latencies_s)), "answered")
        if self.drops.total:
            table.add_row("dropped", str(self.drops.total), _by_place(self.drops))
        if self.kept_pct < 100:
            table.add_row("kept", f"{self.kept_pct:.1f} %", "of the values, after the filters")
        table.add_row("fps", f"{self.fps:.1f}", "end to end")
        table.add_row("first frame", f"{first_ms:.1f} ms", "cold: from sending it to its depth")
        if len(self.latencies_s) > 1:
            table.add_row("latency p50", f"{p50_ms:.1f} ms", "the same, of all later frames")
            table.add_row("latency p95", f"{p95_ms:.1f} ms")
        table.add_row("model p50", f"{model_ms:.1f} ms", "time of the network alone")
        if mean := self.accuracy:
            table.add_row("EPE", f"{mean.epe_px:.2f} px", "mean absolute error of disparity")
            table.add_row("D1", f"{mean.d1_pct:.1f} %", "pixels off by more than 1 px")
            table.add_row("D3", f"{mean.d3_pct:.1f} %", "by more than 3 px")
        return table


def _milliseconds(seconds: Sequence[float]) -> tuple[float, float, float]:
    """Return the first value, and the 50th and the 95th percentile of the others.

    The first frame is a cold start in new buffers, often ten times as slow as every later one.
    """
    if not seconds:
        return 0.0, 0.0, 0.0
    p50_s, p95_s = np.percentile(seconds[1:] or seconds, (50, 95))
    return 1e3 * seconds[0], 1e3 * float(p50_s), 1e3 * float(p95_s)


def _by_place(drops: Drops) -> str:
    """Name the places where frames were dropped, with their counts."""
    places = {
        "at the source": drops.at_source,
        "without a connection": drops.offline,
        "displaced in the server": drops.displaced,
        "too old": drops.stale,
        "unread": drops.unread,
        "lost with the connection": drops.lost,
    }
    return ", ".join(f"{count} {place}" for place, count in places.items() if count)
