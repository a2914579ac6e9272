"""A TCP proxy between client and server whose wire can be cut."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress


class Proxy:
    """Forwards bytes both ways to one address until it is cut."""

    def __init__(self, target: str) -> None:
        self._target = target
        self._connections: set[asyncio.Task[None]] = set()
        self._writers: set[asyncio.StreamWriter] = set()
        self._whole = True
        self._upward = asyncio.Event()
        self._upward.set()
        self.address = ""
        self.accepted = 0

    def cut(self) -> None:
        """Break every connection, and every new one until :meth:`mend`."""
        self._whole = False
        for writer in self._writers:
            writer.transport.abort()

    def mend(self) -> None:
        self._whole = True
        self._upward.set()

    def lead_to(self, target: str) -> None:
        """Break every connection; new ones go to another address."""
        self._target = target
        self.cut()
        self.mend()

    def hold_upward(self) -> None:
        """What the client sends from now on does not arrive, until :meth:`mend`."""
        self._upward.clear()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._connections.add(task)
        try:
            if not self._whole:
                writer.transport.abort()
                return
            self.accepted += 1
            host, _, port = self._target.rpartition(":")
            server_reader, server_writer = await asyncio.open_connection(host, int(port))
            self._writers |= {writer, server_writer}
            with suppress(OSError):
                async with asyncio.TaskGroup() as tasks:
                    tasks.create_task(self._pump(reader, server_writer, self._upward))
                    tasks.create_task(self._pump(server_reader, writer, None))
        finally:
            self._connections.discard(task)

    async def _pump(
        self,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        gate: asyncio.Event | None,
    ) -> None:
        with suppress(OSError):
            while data := await reader.read(1 << 16):
                if gate is not None:
                    await gate.wait()
                writer.write(data)
                await writer.drain()
        self._writers.discard(writer)
        writer.transport.abort()

    async def close(self) -> None:
        self.cut()
        for task in list(self._connections):
            task.cancel()
        await asyncio.gather(*self._connections, return_exceptions=True)


@asynccontextmanager
async def proxy_to(target: str) -> AsyncIterator[Proxy]:
    proxy = Proxy(target)
    server = await asyncio.start_server(proxy.serve, "127.0.0.1", 0)
    proxy.address = f"127.0.0.1:{server.sockets[0].getsockname()[1]}"
    try:
        async with server:
            yield proxy
            await proxy.close()
    finally:
        await proxy.close()
