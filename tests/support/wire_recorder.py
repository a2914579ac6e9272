"""The bytes between an SDK and a server, recorded and read back.

``python -m`` this module SERVER FILE passes the gRPC calls to its own port on to SERVER, prints the
port, and writes what passed to FILE when the standard input ends. So ``released_session.bin`` is
made of a checkout of the last release: its server with the tests' ``RecallModel``, and its SDK with
the frames of ``released_pairs``, opened with ``released_rig`` and stepped with the identity as the
pose.
"""

import asyncio
import sys
import zlib
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import grpc
import numpy as np

from vergence_proto.geometry import RectifiedRig
from vergence_proto.types import Image

Recorded = list[tuple[str, bytes]]
"""In order: the method with ``>`` (to the server) or ``<``, and the message."""

released_rig = RectifiedRig(64, 48, 60.0, 60.0, 31.5, 31.5, 23.5, 0.1)


def released_pairs() -> list[tuple[Image, Image]]:
    """Return the pairs of the recorded session."""
    v, u = np.mgrid[:48, :64]
    lefts = [np.dstack([u * 3 + index, v * 5, u + v]) % 256 for index in range(3)]
    return [(each.astype(np.uint8), (each // 2).astype(np.uint8)) for each in lefts]


def read_recorded(path: Path) -> Recorded:
    """Read a file of this module."""
    data, recorded, at = zlib.decompress(path.read_bytes()), [], 0
    while at < len(data):
        name_end = data.index(b"\n", at)
        size, start = int.from_bytes(data[name_end + 1 : name_end + 5], "big"), name_end + 5
        recorded.append((data[at:name_end].decode(), data[start : start + size]))
        at = start + size
    return recorded


class _Recorder(grpc.GenericRpcHandler):  # type: ignore[type-arg]  # not generic at run time
    def __init__(self, channel: grpc.aio.Channel) -> None:
        self._channel = channel
        self.recorded: Recorded = []

    def service(self, handler_call_details: grpc.HandlerCallDetails) -> Any:
        path = str(handler_call_details.method)

        async def passed(requests: AsyncIterator[bytes], context: Any) -> AsyncIterator[bytes]:
            async def up() -> AsyncIterator[bytes]:
                async for request in requests:
                    self.recorded.append((f"{path}>", request))
                    yield request

            metadata = [each for each in context.invocation_metadata() if each[0] == "x-stream-id"]
            start: Any = self._channel.stream_stream
            async for answer in start(path)(up(), metadata=metadata):
                self.recorded.append((f"{path}<", answer))
                yield answer

        return grpc.stream_stream_rpc_method_handler(passed)


async def _record(target: str) -> bytes:
    async with grpc.aio.insecure_channel(target) as channel:
        recorder = _Recorder(channel)
        server = grpc.aio.server()
        server.add_generic_rpc_handlers((recorder,))
        print(server.add_insecure_port("127.0.0.1:0"), flush=True)  # noqa: T201
        await server.start()
        await asyncio.to_thread(sys.stdin.read)
        await server.stop(None)
    content = b"".join(
        name.encode() + b"\n" + len(message).to_bytes(4, "big") + message
        for name, message in recorder.recorded
    )
    return zlib.compress(content, 9)


if __name__ == "__main__":
    Path(sys.argv[2]).write_bytes(asyncio.run(_record(sys.argv[1])))
