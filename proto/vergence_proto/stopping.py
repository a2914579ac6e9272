"""The signals by which a system ends a program, for event loops of every platform."""

import asyncio
import os
import signal
import threading
from collections.abc import Callable, Iterable
from contextlib import suppress

# SIGHUP: the terminal was closed. SIGBREAK: what Windows has instead of SIGTERM.
STOP_SIGNALS = ("SIGTERM", "SIGINT", "SIGHUP", "SIGBREAK")


def on_signals(names: Iterable[str], stop: Callable[[int], object]) -> None:
    """Call ``stop`` with the number of a signal, in the running loop, when it comes.

    Call this in the main thread. Names that this system does not have are passed over, and a
    SIGHUP that is ignored stays so: ``nohup`` asks for that.
    """
    loop = asyncio.get_running_loop()
    for name in names:
        number = getattr(signal, name, None)
        if number is None:
            continue
        if name == "SIGHUP" and signal.getsignal(number) is signal.SIG_IGN:
            continue
        try:
            loop.add_signal_handler(number, stop, number)
        except NotImplementedError:  # no event loop of Windows has it
            signal.signal(number, lambda at, _: _call(loop, stop, at))


def on_end_of_input(stop: Callable[[int], object]) -> None:
    """Call ``stop`` with 0, in the running loop, when the standard input ends.

    The program at the other end of a pipe closes it by ending, however it ends.
    """
    loop = asyncio.get_running_loop()

    def read() -> None:
        with suppress(OSError):
            while os.read(0, 1024):
                pass
        _call(loop, stop, 0)

    # A daemon, because nothing can wake a thread that waits for input when the program ends.
    threading.Thread(target=read, name="end of input", daemon=True).start()


def _call(loop: asyncio.AbstractEventLoop, stop: Callable[[int], object], number: int) -> None:
    with suppress(RuntimeError):  # the loop is closed: the program has ended anyway
        loop.call_soon_threadsafe(stop, number)
