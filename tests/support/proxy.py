"""A TCP proxy between client and server: its wire can be cut, go silent, or be long."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress


class Proxy:
    """Forwards bytes both ways to one address until it is cut.

    ``delay_s`` is the time of a byte from one end to the other; a new connection takes a round trip
    before its first byte, as TCP's handshake does. With ``whole_requests`` an HTTP request of
    unknown length does not arrive, because its end does not come.
    """

    def __init__(self, target: str, *, delay_s: float = 0.0, whole_requests: bool = False) -> None:
        self._whole_requests = whole_requests
        self._target = target
        self._delay_s = delay_s
        self._connections: set[asyncio.Task[None]] = set()
        self._writers: set[asyncio.StreamWriter] = set()
        self._whole = True
        self._upward = _open_gate()
        self._wire = _open_gate()
        self._dead: set[asyncio.Event] = set()  # the gates of forgotten connections
        self.address = ""
        self.accepted = 0

    def cut(self) -> None:
        """Break every connection, and every new one until :meth:`mend`."""
        self._whole = False
        for writer in self._writers:
            writer.transport.abort()

    def mend(self) -> None:
        """Let everything through again, held bytes first."""
        self._whole = True
        self._upward.set()
        self._wire.set()

    def lead_to(self, target: str) -> None:
        """Break every connection; new ones go to another address."""
        self._target = target
        self.cut()
        self.mend()

    def hold_upward(self) -> None:
        """What the client sends from now on does not arrive, until :meth:`mend`."""
        self._upward.clear()

    def fall_silent(self) -> None:
        """Nothing passes, either way or on new connections, until :meth:`mend`."""
        self._wire.clear()

    def forget_connections(self) -> None:
        """Nothing passes on the connections of now, for ever; new ones work.

        So it is when the client's address has changed.
        """
        self._wire.clear()
        self._dead.add(self._wire)
        self._wire = _open_gate()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._connections.add(task)
        writers = [writer]
        try:
            if not self._whole:
                return
            self.accepted += 1
            upward, wire = self._upward, self._wire
            await asyncio.sleep(2 * self._delay_s)
            host, _, port = self._target.rpartition(":")
            server_reader, server_writer = await asyncio.open_connection(host, int(port))
            writers.append(server_writer)
            self._writers.update(writers)
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(self._pump(reader, server_writer, upward, wire))
                tasks.create_task(self._pump(server_reader, writer, wire))
        except (OSError, asyncio.CancelledError):
            pass  # the target is gone, or close() was called
        finally:
            self._connections.discard(task)
            self._writers.difference_update(writers)
            for each in writers:
                each.transport.abort()

    async def _pump(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *gates: asyncio.Event
    ) -> None:
        travelling: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue()
        loop = asyncio.get_running_loop()

        async def arrive() -> None:
            while True:
                due_s, data = await travelling.get()
                await asyncio.sleep(due_s - loop.time())
                for gate in gates:
                    await gate.wait()
                if not data:
                    return
                writer.write(data)
                await writer.drain()

        arriving = asyncio.create_task(arrive())
        try:
            with suppress(OSError):
                endless = False
                while data := await reader.read(1 << 16):
                    endless |= self._whole_requests and len(gates) > 1 and b"chunked" in data
                    if endless:
                        continue
                    travelling.put_nowait((loop.time() + self._delay_s, data))
                travelling.put_nowait((loop.time() + self._delay_s, b""))
                if not self._dead.intersection(gates):
                    await arriving
        finally:
            arriving.cancel()
            writer.transport.abort()

    async def close(self) -> None:
        self.cut()
        for task in list(self._connections):
            task.cancel()
        await asyncio.gather(*self._connections, return_exceptions=True)


def _open_gate() -> asyncio.Event:
    gate = asyncio.Event()
    gate.set()
    return gate


@asynccontextmanager
async def proxy_to(
    target: str, *, delay_s: float = 0.0, whole_requests: bool = False
) -> AsyncIterator[Proxy]:
    proxy = Proxy(target, delay_s=delay_s, whole_requests=whole_requests)
    server = await asyncio.start_server(proxy.serve, "127.0.0.1", 0)
    proxy.address = f"127.0.0.1:{server.sockets[0].getsockname()[1]}"
    try:
        async with server:
            yield proxy
            await proxy.close()
    finally:
        await proxy.close()
