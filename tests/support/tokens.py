"""Files of tokens, and clients that show one."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import grpc
import httpx

from tests.support.server import PATIENCE_S
from vergence_proto.v1 import depth_pb2_grpc
from vergence_service.access.principals import Principal, Role
from vergence_service.access.tokens import digest_of, new_token, write_tokens
from vergence_service.app.server import Running


class TokenFile:
    """A file with one token for each principal."""

    def __init__(self, path: Path, *names: str, admins: tuple[str, ...] = ()) -> None:
        self.path = path
        self._admins = admins
        self.tokens = {name: new_token() for name in (*names, *admins)}
        self.write()

    def write(self) -> None:
        entries = {
            digest_of(token): Principal(name, Role.ADMIN if name in self._admins else Role.USER)
            for name, token in self.tokens.items()
        }
        write_tokens(self.path, entries)

    def shown(self, name: str) -> dict[str, str]:
        """The headers of a request of this principal; of a stranger for another name."""
        return {"authorization": f"Bearer {self.tokens.get(name, 'vrg_guessed')}"}


@asynccontextmanager
async def http_as(server: Running, headers: dict[str, str]) -> AsyncIterator[httpx.AsyncClient]:
    base = f"http://{server.http_address}"
    async with httpx.AsyncClient(base_url=base, timeout=PATIENCE_S, headers=headers) as client:
        yield client


@asynccontextmanager
async def stub(server: Running) -> AsyncIterator[depth_pb2_grpc.DepthServiceStub]:
    """Methods on a connection of their own; the metadata of each call says who calls."""
    options = [("grpc.use_local_subchannel_pool", 1)]
    async with grpc.aio.insecure_channel(server.grpc_address, options=options) as channel:
        yield depth_pb2_grpc.DepthServiceStub(channel)
