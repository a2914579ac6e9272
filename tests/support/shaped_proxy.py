"""A proxy that shapes the bytes of TCP connections as a bad link would, without root.

It is coarser than :mod:`tests.support.tun_link`: nothing is lost, and TCP's own behaviour over the
link is missing.
"""

import asyncio
import dataclasses
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tests.support.tun_link import Direction, LinkShape

_PIECE_BYTES = 1400
_REPOSITORY = Path(__file__).parents[2]


@contextmanager
def shaped_proxy(target: str, shape: LinkShape) -> Iterator[tuple[str, float]]:
    """Start a proxy to ``target``; yields its address, and when its stalls began to count."""
    command = [sys.executable, "-m", "tests.support.shaped_proxy", target]
    command.append(json.dumps(dataclasses.asdict(shape)))
    with subprocess.Popen(command, cwd=_REPOSITORY, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        address, started_s = process.stdout.readline().split()
        try:
            yield address, float(started_s)
        finally:
            process.terminate()


async def _pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, way: Direction) -> None:
    due = asyncio.Event()

    async def deliver() -> None:
        while True:
            wait_s = way.next_due_s - time.monotonic()
            if wait_s > 0:
                due.clear()
                with suppress(TimeoutError):
                    await asyncio.wait_for(due.wait(), min(wait_s, 1.0))
            elif packet := way.take(time.monotonic()):
                writer.write(packet)
            else:
                return

    async with asyncio.TaskGroup() as tasks:
        delivering = tasks.create_task(deliver())
        while data := await reader.read(_PIECE_BYTES):
            await asyncio.sleep(way.room_in_s(time.monotonic()))
            way.put(data, time.monotonic())
            due.set()
        delivering.cancel()
    writer.transport.abort()


async def _serve(target: str, shape: LinkShape) -> None:
    started_s = time.monotonic()
    host, _, port = target.rpartition(":")

    async def carry(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        far_reader, far_writer = await asyncio.open_connection(host, int(port))
        up, down = (Direction(shape, started_s=started_s, seed=seed) for seed in (1, 2))
        with suppress(OSError, ExceptionGroup):
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(_pump(reader, far_writer, up))
                tasks.create_task(_pump(far_reader, writer, down))

    server = await asyncio.start_server(carry, "127.0.0.1", 0)
    address = ":".join(map(str, server.sockets[0].getsockname()))
    print(address, started_s, flush=True)  # noqa: T201  the parent reads it
    await server.serve_forever()


if __name__ == "__main__":
    _target, _shape = sys.argv[1:]
    asyncio.run(_serve(_target, LinkShape(**json.loads(_shape))))
