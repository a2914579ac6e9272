"""``vergence serve`` with leaks: what a soak must find. ``python -m`` this module."""

import os
import threading

from vergence_service.app import command
from vergence_service.streams.stream import Stream
from vergence_service.streams.table import StreamTable

_LEAKED: list[object] = []
_EVERY = 8  # of so many streams, one leaves a thread; each leaves memory and a descriptor


def main() -> None:
    close = StreamTable.close

    def leave_behind(table: StreamTable, stream: Stream) -> None:
        _LEAKED.append((os.dup(0), bytearray(os.urandom(200_000))))
        if len(_LEAKED) % _EVERY == 1:
            threading.Thread(target=threading.Event().wait, daemon=True).start()
        close(table, stream)

    StreamTable.close = leave_behind  # type: ignore[method-assign, assignment] # the leak
    command.run_server({"grpc.port": 0, "http.port": 0}, config=None, print_config=False)


if __name__ == "__main__":
    main()
