"""A real Redis server on a free port, for the length of a block."""

import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import redis

_PATIENCE_S = 10.0


class RedisServer:
    """Redis without files. ``admin`` is a client that nothing disturbs."""

    def __init__(self, folder: Path) -> None:
        self._program = shutil.which("redis-server")
        if self._program is None:
            raise FileNotFoundError(
                "these tests need redis-server: apt-get install redis-server; or leave them out "
                'with: pytest -m "not slow"'
            )
        self._folder = folder
        self.port = _free_port()
        self.address = f"127.0.0.1:{self.port}"
        self.url = f"redis://{self.address}/0"
        self.admin: Any = redis.Redis(port=self.port)  # its types are those of every protocol
        self.start()

    def start(self) -> None:
        command = [self._program or "", "--port", str(self.port), "--bind", "127.0.0.1"]
        command += ["--save", "", "--appendonly", "no", "--dir", str(self._folder)]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        until_s = time.monotonic() + _PATIENCE_S
        while time.monotonic() < until_s:
            with suppress(redis.ConnectionError):
                self.admin.ping()
                return
            time.sleep(0.01)
        raise TimeoutError("redis-server does not answer")

    def send(self, number: signal.Signals) -> None:
        self._process.send_signal(number)

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()

    def names(self) -> list[bytes]:
        return list(self.admin.scan_iter())


@contextmanager
def redis_server() -> Iterator[RedisServer]:
    with TemporaryDirectory() as folder:
        server = RedisServer(Path(folder))
        try:
            yield server
        finally:
            server.kill()
            server.admin.close()


def _free_port() -> int:
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        port: int = listening.getsockname()[1]
        return port
