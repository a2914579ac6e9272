"""A connection that breaks: the session reconnects, and the stream keeps its memory.

Run: ``python client/examples/05_reconnect.py --server grpc://127.0.0.1:50051``
"""

# ruff: noqa: T201  an example prints

import argparse
import asyncio
from contextlib import closing, suppress
from importlib.resources import files
from itertools import islice

import vergence
from vergence_proto.datasets import open_source

writers: list[asyncio.StreamWriter] = []


async def pipe(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Forward bytes until one side closes."""
    writers.append(writer)
    with closing(writer), suppress(ConnectionError):
        while data := await reader.read(1 << 16):
            writer.write(data)
            await writer.drain()


async def main() -> None:
    """Step twelve frames through a relay, and cut the relay's connection after the fourth."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--server", default=vergence.DEFAULT_SERVER)
    host, _, port = parser.parse_args().server.removeprefix("grpc://").rpartition(":")

    async def relay(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        from_server, to_server = await asyncio.open_connection(host, int(port))
        await asyncio.gather(pipe(reader, to_server), pipe(from_server, writer))

    room = open_source(f"vergence:{files('vergence') / 'sample' / 'room'}")
    listening = asyncio.start_server(lambda *ends: tasks.create_task(relay(*ends)), host, 0)
    async with asyncio.TaskGroup() as tasks, await listening as relaying:
        address = f"grpc://{host}:{relaying.sockets[0].getsockname()[1]}"
        async with vergence.DepthClient(address) as client:
            session = client.open_session(room.rig, on_event=lambda event: print(event.message))
            async with session:
                for each in islice(room, 12):
                    if each.frame.frame_id == 5:
                        for writer in writers:
                            writer.transport.abort()
                    # A step that the server has not taken is sent again. ConnectionLost is raised
                    # if only its answer was lost.
                    result = await session.step(each.frame.left, each.frame.right, each.frame.pose)
                    print(f"frame {result.frame_id}: {result.origin.value}, {result.step_count}")


if __name__ == "__main__":
    asyncio.run(main())
