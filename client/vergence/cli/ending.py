"""The end of a command by a signal: it cleans up as after Ctrl-C, and the exit code says so."""

import asyncio
from collections.abc import Coroutine
from typing import Any, TypeVar

from vergence_proto.stopping import STOP_SIGNALS, on_signals

Value = TypeVar("Value")

_BY_SIGNAL = 128  # added to the signal's number, as shells do


def run_until_stopped(work: Coroutine[Any, Any, Value]) -> Value:
    """Run ``work``. SIGTERM, SIGHUP and, on Windows, SIGBREAK cancel it, as asyncio lets Ctrl-C do.

    Raises SystemExit with 128 plus the signal's number after a signal, and what ``work`` raises.
    """
    stopped_by: list[int] = []

    async def main() -> Value:
        working = asyncio.ensure_future(work)

        def stop(number: int) -> None:
            if not stopped_by:  # a second signal must not disturb the cleaning up
                working.cancel()
            stopped_by.append(number)

        on_signals((name for name in STOP_SIGNALS if name != "SIGINT"), stop)
        return await working

    try:
        return asyncio.run(main())
    except asyncio.CancelledError:
        if not stopped_by:
            raise
        raise SystemExit(_BY_SIGNAL + stopped_by[0]) from None
