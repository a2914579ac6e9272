"""An event loop in a thread of its own, for programs without one."""

import asyncio
import os
import threading
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from vergence.errors import NotOpen
from vergence.transports.forks import FORKED

Value = TypeVar("Value")


class LoopThread:
    """An event loop in a thread, between :meth:`start` and :meth:`stop`."""

    def __init__(self) -> None:
        self._loop: asyncio.AbstractEventLoop | None = None
        self._process = os.getpid()

    def start(self) -> None:
        started = threading.Event()
        # Not a daemon: stop() ends it, and never in the middle of a callback.
        self._thread = threading.Thread(target=self._main, args=(started,), name="vergence-client")
        self._thread.start()
        started.wait()

    def _main(self, started: threading.Event) -> None:
        with asyncio.Runner() as runner:  # its exit cancels and awaits the remaining tasks
            loop = runner.get_loop()
            self._loop = loop
            loop.call_soon(started.set)
            loop.run_forever()

    def stop(self) -> None:
        loop, self._loop = self._loop, None
        if loop is not None:
            loop.call_soon_threadsafe(loop.stop)
            self._thread.join()

    def wait(self, work: Coroutine[Any, Any, Value]) -> Value:
        if self._process != os.getpid():  # the thread stayed behind in the other process
            work.close()
            raise NotOpen(FORKED)
        if self._loop is None:
            work.close()
            raise NotOpen("the client is not open; write: with BlockingClient(server) as client")
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result()
        except BaseException:  # after an interrupt nobody waits for the result any more
            future.cancel()
            raise

    def call(self, function: Callable[[], Value]) -> Value:
        """Run a function in the loop's thread: a session must not be used from another one."""

        async def run() -> Value:
            return function()

        return self.wait(run())
