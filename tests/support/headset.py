"""A headset that plays a recorded sequence to and fro, live, and notes what its display would have.

``python -m`` this module runs one in a process of its own: a JSON object of :class:`Plan` as the
argument, a JSON object of figures on the standard output.
"""

import asyncio
import dataclasses
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from vergence import (
    Delivery,
    DepthClient,
    DepthResult,
    DepthSession,
    ImageEncoding,
    OutputFormat,
    Pose,
    RectifiedRig,
)
from vergence.recent import RecentResults
from vergence_proto.accuracy import accuracy
from vergence_proto.datasets import open_source
from vergence_proto.types import Image

_TICK_S = 1 / 72
_TICKS_SCORED = 24
_SETTLE_S = 3.0  # nothing is measured before

Kind = Literal["sdk", "today", "naive"]


@dataclass(frozen=True, slots=True)
class Plan:
    """What the headset does. ``stall_*`` describe stalls of the link; 0: there are none."""

    server: str
    sequence: str
    kind: Kind
    seconds: float
    camera_hz: float = 30.0
    record: str = ""  # the maps that the server answers with, for the errors
    stall_every_s: float = 0.0
    stall_ms: float = 0.0
    stalls_from_s: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Sequence:
    """The frames to play."""

    rig: RectifiedRig
    pairs: list[tuple[Image, Image]]
    poses: list[Pose]
    truths_px: list[NDArray[np.float32]]  # NaN: not known

    @classmethod
    def load(cls, path: str) -> "Sequence":
        source = open_source(f"vergence:{path}")
        rig = source.rig.as_rectified()
        assert rig is not None
        pairs, poses, truths = [], [], []
        for each in source:
            assert each.frame.pose is not None
            assert each.truth_px is not None
            assert each.truth_mask is not None
            pairs.append((each.frame.left, each.frame.right))
            poses.append(each.frame.pose.world_from_left)
            truths.append(np.where(each.truth_mask, each.truth_px, np.nan).astype(np.float32))
        return cls(rig, pairs, poses, truths)

    def at(self, count: int) -> int:
        """Return the index of a frame: to and fro, for ever."""
        last = len(self.pairs) - 1
        count %= 2 * last
        return count if count <= last else 2 * last - count


class Headset:
    """Films with one session, and keeps the results with the times of their arrival."""

    def __init__(self, plan: Plan, sequence: Sequence) -> None:
        self._plan = plan
        self._sequence = sequence
        self._period_s = 1 / plan.camera_hz
        self.arrivals: list[tuple[float, DepthResult]] = []
        self.links: list[dict[str, Any]] = []
        self.drops: dict[str, int] = {}
        self.started_s = self.ended_s = 0.0

    def count_at(self, now_s: float) -> int:
        """Return how many frames the camera had taken before the latest one."""
        return int((now_s - self.started_s) / self._period_s)

    async def run(self) -> None:
        """Film for the plan's time."""
        async with DepthClient(self._plan.server) as client, self._session(client) as session:
            self.started_s = time.monotonic()
            self.ended_s = self.started_s + self._plan.seconds
            if self._plan.kind == "naive":
                await self._step(session)
            else:
                async with asyncio.TaskGroup() as tasks:
                    reading = tasks.create_task(self._read(session))
                    await self._film(session)
                    reading.cancel()
            self.drops = dataclasses.asdict(session.drops)

    def _session(self, client: DepthClient) -> DepthSession:
        rig = self._sequence.rig
        match self._plan.kind:
            case "sdk":
                return client.open_session(rig, link="auto")
            case "today":  # version 0.1: raw colour up, every pixel down, and nothing adapts
                return client.open_session(
                    rig,
                    encoding=ImageEncoding.RAW,
                    output=OutputFormat(denominator=64, map_step=1),
                    link="fixed",
                )
            case "naive":  # small images, but request and reply
                return client.open_session(
                    rig, encoding=ImageEncoding.JPEG, delivery=Delivery.EVERY
                )

    async def _film(self, session: DepthSession) -> None:
        count = 0
        while (now_s := time.monotonic()) < self.ended_s:
            due_s = self.started_s + count * self._period_s
            if now_s < due_s:
                await asyncio.sleep(due_s - now_s)
                continue
            count = max(count, self.count_at(now_s))
            index = self._sequence.at(count)
            captured_s = self.started_s + count * self._period_s
            session.submit(
                *self._sequence.pairs[index],
                self._sequence.poses[index],
                capture_ns=int(captured_s * 1e9),
            )
            count += 1
            if count % 10 == 0:
                self.links.append(dataclasses.asdict(session.link))

    async def _read(self, session: DepthSession) -> None:
        async for result in session:
            self.arrivals.append((time.monotonic(), result))

    async def _step(self, session: DepthSession) -> None:
        while (now_s := time.monotonic()) < self.ended_s:
            count = self.count_at(now_s)
            index = self._sequence.at(count)
            captured_s = self.started_s + count * self._period_s
            result = await session.step(
                *self._sequence.pairs[index],
                self._sequence.poses[index],
                capture_ns=int(captured_s * 1e9),
            )
            self.arrivals.append((time.monotonic(), result))
            next_s = self.started_s + (self.count_at(time.monotonic()) + 1) * self._period_s
            await asyncio.sleep(next_s - time.monotonic())

    def figures(self) -> dict[str, Any]:
        """Return the figures: rates and ages of a display of 72 Hz, and the errors at its times."""
        from_s = self.started_s + _SETTLE_S
        ticks_s = np.arange(from_s, self.ended_s, _TICK_S)
        ticks_s = ticks_s[~self._stalled(ticks_s)]
        arrived_s = np.array([at_s for at_s, _ in self.arrivals])
        newest = np.searchsorted(arrived_s, ticks_s, side="right") - 1
        ages_s = np.array(
            [
                at_s - self.arrivals[index][1].capture_ns * 1e-9 if index >= 0 else np.nan
                for at_s, index in zip(ticks_s, newest, strict=True)
            ]
        )
        results = ((arrived_s >= from_s) & (arrived_s < self.ended_s)).sum()
        return {
            "results_hz": round(float(results) / (self.ended_s - from_s), 1),
            "age_p50_ms": _milliseconds(np.nanpercentile(ages_s, 50)),
            "age_p95_ms": _milliseconds(np.nanpercentile(ages_s, 95)),
            "age_max_ms": _milliseconds(np.nanmax(ages_s)),
            "drops": self.drops,
            "links": self.links,
            **(self._errors(ticks_s) if self._plan.kind == "sdk" else {}),
        }

    def _stalled(self, ticks_s: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which ticks are in a stall of the link."""
        plan = self._plan
        if not plan.stall_every_s:
            return np.zeros(len(ticks_s), bool)
        since_s = ticks_s - plan.stalls_from_s
        return (since_s >= plan.stall_every_s) & (
            since_s % plan.stall_every_s < plan.stall_ms * 1e-3
        )

    def _errors(self, ticks_s: NDArray[np.float64]) -> dict[str, float]:
        """Return the errors of ``depth_at`` over those of a map of that moment."""
        with np.load(self._plan.record) as content:
            fresh_px = content["maps"]
        scored = ticks_s[:: max(len(ticks_s) // _TICKS_SCORED, 1)]
        recent, arrivals = RecentResults(), iter(self.arrivals)
        pending = next(arrivals, None)
        rows, covered, took_s = [], [], []
        for tick_s in scored:
            while pending is not None and pending[0] <= tick_s:
                recent.add(pending[1])
                pending = next(arrivals, None)
            index = self._sequence.at(self.count_at(tick_s))
            began_s = time.process_time()
            seen = recent.depth_at(
                self._sequence.poses[index],
                None,
                at_ns=int(tick_s * 1e9),
                fill="far",
                max_age_s=60.0,
            )
            took_s.append(time.process_time() - began_s)
            assert seen is not None
            rig, truth_px = self._sequence.rig, self._sequence.truths_px[index]
            shown_px = rig.fx * rig.baseline_m / seen.depth_m
            covered.append(seen.covered.mean())
            rows.append(
                [
                    accuracy(each, truth_px, mask).epe_px
                    for mask in (seen.covered & np.isfinite(truth_px), np.isfinite(truth_px))
                    for each in (shown_px, fresh_px[index])
                ]
            )
        shown_covered, fresh_covered, shown_all, fresh_all = np.mean(rows, axis=0)
        return {
            "epe_ratio_covered": round(float(shown_covered / fresh_covered), 3),
            "epe_ratio_all": round(float(shown_all / fresh_all), 3),
            "covered": round(float(np.mean(covered)), 3),
            "depth_at_ms": round(float(np.median(took_s)) * 1e3, 1),
        }


def _milliseconds(seconds: np.floating[Any]) -> int:
    return round(float(seconds) * 1e3)


def main() -> None:
    """Run one headset and print its figures."""
    plan = Plan(**json.loads(sys.argv[1]))
    headset = Headset(plan, Sequence.load(plan.sequence))
    asyncio.run(headset.run())
    Path("/dev/stdout").write_text(json.dumps(headset.figures()) + "\n")


if __name__ == "__main__":
    main()
