"""Film over a link that is cut, or to a server that is killed; note what the program sees of it.

``python -m`` this module films in a process of its own: {"servers", "seconds"} as JSON, one session
for each server. It prints "live" when all have results. A line "cut RETURN" then gives the times of
the cut and of the return of the link, on time.monotonic(). Its figures are a JSON object.
"""

import asyncio
import gc
import itertools
import json
import os
import sys
import threading
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tests.support.frames import RIG, make_frame
from tests.support.models import RecallModel
from vergence import (
    DepthClient,
    DepthResult,
    DepthSession,
    EventKind,
    ImageEncoding,
    Origin,
    OutputFormat,
    PlaneEncoding,
    SessionEvent,
    SessionState,
)
from vergence_proto.types import StereoFrame
from vergence_service.inference.model import RecurrentState, Step, StereoView

# Zenoh gives up an attempt to connect after five seconds.
_LEFT_AT_MOST_S = 6.0
_PERIOD_S = 1 / 30
_EXACT = OutputFormat(encoding=PlaneEncoding.FLOAT32)


@dataclass(eq=False)
class Film:
    """One session, its frames, and what came of them."""

    server: str
    results: list[tuple[float, DepthResult]] = field(default_factory=list)
    events: list[tuple[float, SessionEvent]] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)
    sent: dict[int, StereoFrame] = field(default_factory=dict)
    silent_at_s: list[float] = field(default_factory=list)  # when the state was not live
    round_trip_s: float = 0.0

    async def run(self, live: asyncio.Barrier, stop: asyncio.Event) -> None:
        """Film until ``stop``; every exception that reaches the program is noted."""
        try:
            async with DepthClient(self.server) as client:
                session = client.open_session(
                    RIG,
                    encoding=ImageEncoding.RAW,
                    output=_EXACT,
                    link="auto",
                    on_event=self._note,
                )
                async with session:
                    reading = asyncio.create_task(self._read(session))
                    await self._film(session, live, stop)
                    session.end()
                    await asyncio.wait({reading}, timeout=5)
                    reading.cancel()
        except Exception as error:
            self.errors.append(f"{type(error).__name__}: {error}")

    def _note(self, event: SessionEvent) -> None:
        self.events.append((time.monotonic(), event))

    async def _read(self, session: DepthSession) -> None:
        try:
            async for result in session:
                self.results.append((time.monotonic(), result))
        except Exception as error:
            self.errors.append(f"reading: {type(error).__name__}: {error}")

    async def _film(
        self, session: DepthSession, live: asyncio.Barrier, stop: asyncio.Event
    ) -> None:
        count, waits = 0, True
        arriving: asyncio.Task[int] | None = None
        while not stop.is_set():
            count += 1
            shot = make_frame(count % 40, brightness=30 + count % 170)
            try:
                frame_id = session.submit(
                    shot.left, shot.right, shot.pose, capture_ns=time.monotonic_ns()
                )
            except Exception as error:
                self.errors.append(f"submit: {type(error).__name__}: {error}")
                return
            if isinstance(frame_id, int):
                self.sent[frame_id] = shot
            if session.state is not SessionState.LIVE:
                self.silent_at_s.append(time.monotonic())
            self.round_trip_s = max(self.round_trip_s, session.link.path_round_trip_s or 0.0)
            if waits and len(self.results) >= 30:
                waits = False
                arriving = asyncio.create_task(live.wait())
            await asyncio.sleep(_PERIOD_S)
        if arriving is not None:
            arriving.cancel()

    def figures(self, cut_s: float, return_s: float) -> dict[str, Any]:
        """Return what the outage cost."""
        # By their capture: answers that were on their way may arrive after the cut.
        cut_ns = cut_s * 1e9
        before = [each for _, each in self.results if each.capture_ns < cut_ns]
        after = [
            (at_s, each)
            for at_s, each in self.results
            if at_s >= return_s and each.capture_ns >= cut_ns
        ]
        warm_s = next(
            (at_s for at_s, each in after if each.origin in (Origin.WARM, Origin.RESUMED)), None
        )
        reported_s = next((at_s for at_s in self.silent_at_s if at_s > cut_s), None)
        kept = bool(after) and after[0][1].step_count > before[-1].step_count
        return {
            "errors": self.errors,
            "events": [f"{at_s - cut_s:.2f} s {event.kind}" for at_s, event in self.events],
            "reported_s": None if reported_s is None else round(reported_s - cut_s, 2),
            "round_trip_s": round(self.round_trip_s, 3),
            "first_result_s": round(after[0][0] - return_s, 2) if after else None,
            "warm_again_s": None if warm_s is None else round(warm_s - return_s, 2),
            "restarted": any(event.kind is EventKind.RESTARTED for _, event in self.events),
            "state_kept": kept,
            "same_bits": self._same_bits(before[-1], after[0][1]) if kept else None,
        }

    def _same_bits(self, last: DepthResult, first: DepthResult) -> bool:
        """Return True if ``first`` is what a session without an outage would have given.

        Which of the frames without an answer were stepped is not known, only how many.
        """
        between = [each for each in self.sent if last.frame_id < each < first.frame_id]
        known = [each for _, each in self.results if last.step_count >= each.step_count]
        stepped = [self.sent[each.frame_id] for each in known]
        missing = first.step_count - last.step_count - 1
        model, state = RecallModel(), None
        for frame in stepped:
            state, _ = _stepped(model, frame, state)
        for chosen in itertools.combinations(between, missing):
            now = state
            for frame_id in (*chosen, first.frame_id):
                now, offset_px = _stepped(model, self.sent[frame_id], now)
            if np.array_equal(offset_px, first.offset_px):
                return True
        return False


def _stepped(
    model: RecallModel, frame: StereoFrame, state: RecurrentState | None
) -> tuple[RecurrentState, Any]:
    assert frame.pose is not None
    view = StereoView(frame.left, frame.right, RIG, 0, frame.pose.world_from_left)
    [result] = model.step([Step(view, state, 1 if state else 4)])
    return result.state, result.offset_px


def _left() -> dict[str, int]:
    gc.collect()
    return {
        "descriptors": len(os.listdir("/proc/self/fd")),
        "threads": len(threading.enumerate()),
        "tasks": len(asyncio.all_tasks()) - 1,
    }


def _more_than(before: dict[str, int]) -> dict[str, int]:
    return {name: n - before[name] for name, n in _left().items() if n > before[name]}


async def _exercise(server: str) -> None:
    """Use a transport once, so that what it keeps for the process is there before."""
    async with DepthClient(server) as client, client.open_session(RIG):
        pass


async def outage(servers: list[str]) -> dict[str, Any]:
    """Film with all servers, through one outage."""
    for server in servers:
        await _exercise(server)
    await asyncio.to_thread(time.sleep, 0.5)
    before = _left()
    films = [Film(server) for server in servers]
    live, stop = asyncio.Barrier(len(films) + 1), asyncio.Event()
    async with asyncio.TaskGroup() as tasks:
        for film in films:
            tasks.create_task(film.run(live, stop))
        async with asyncio.timeout(60):
            await live.wait()
        print("live", flush=True)  # noqa: T201  the parent reads it
        line = await asyncio.to_thread(sys.stdin.readline)
        cut_s, return_s = map(float, line.split())
        await asyncio.sleep(return_s - time.monotonic() + 8)
        stop.set()
    waits_until_s = time.monotonic() + _LEFT_AT_MOST_S
    while (left := _more_than(before)) and time.monotonic() < waits_until_s:  # noqa: ASYNC110
        await asyncio.sleep(0.2)
    return {"left": left} | {
        film.server.partition(":")[0]: film.figures(cut_s, return_s) for film in films
    }


if __name__ == "__main__":
    print(json.dumps(asyncio.run(outage(**json.loads(sys.argv[1])))))  # noqa: T201
