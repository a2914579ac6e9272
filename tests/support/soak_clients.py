"""Clients of every manner: they open, resume, cancel, die, stay silent, read slowly, and send junk.

``python -m`` this module, then

- ``GRPC HTTP SEED SECONDS COUNT``: so many clients, for so long; prints what they did as JSON.
- ``GRPC``: one client that streams until it is killed.

If the server has TLS, ``VERGENCE_CA`` names its authority, and ``SOAK_TOKENS`` has tokens of
several principals, with commas between them.
"""

import asyncio
import io
import json
import os
import random
import signal
import ssl
import sys
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import grpc
import httpx
import numpy as np

from tests.support.frames import RIG, frame_message, make_frame, open_message
from tests.support.http import ZIP
from tests.support.sequences import make_frames, sequence_files, zip_bytes
from vergence import Delivery, DepthClient, Pose
from vergence_proto.errors import DepthError
from vergence_proto.geometry import RectifiedRig
from vergence_proto.types import StereoRig
from vergence_proto.v1 import depth_pb2 as pb
from vergence_proto.v1 import depth_pb2_grpc

LARGE = RectifiedRig(320, 240, 300.0, 300.0, 159.5, 159.5, 119.5, 0.1)
_OWN = (("grpc.use_local_subchannel_pool", 1),)
_PATIENCE_S = 20.0
_EOF = grpc.aio.EOF  # type: ignore[attr-defined] # its stubs leave it out
_JUNK = (b"", b"GET /", b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", b"\x16\x03\x01\x02\x00", b"\0" * 64)
_POST = b"POST /v1/sequences HTTP/1.1\r\nHost: [::1]\r\nContent-Length: 100000\r\n"
_IN_TIME = (grpc.aio.AioRpcError, asyncio.InvalidStateError, TimeoutError, OSError, DepthError)


_CA = os.environ.get("VERGENCE_CA")
_TOKENS = os.environ.get("SOAK_TOKENS", "").split(",")


@dataclass(eq=False)
class Clients:
    """Random clients of one server. ``seen`` counts what they did and how it went."""

    grpc_address: str
    http_address: str
    rng: random.Random
    token: str
    archive: bytes = field(default_factory=lambda: zip_bytes(sequence_files(make_frames(4))))
    seen: Counter[str] = field(default_factory=Counter)
    opened: int = 0

    async def run(self, until: Callable[[], bool]) -> None:
        """Act at random until ``until()`` is true."""
        kinds: dict[Callable[[], Awaitable[None]], int] = {
            self.ends: 6,
            self.cancels: 6,
            self.resumes: 4,
            self.is_closed_by_another: 3,
            self.sends_garbage: 3,
            self.uses_the_sdk: 4,
            self.never_begins: 1,
            self.is_silent: 1,
            self.does_not_read: 1,
            self.dies: 1,
            self.half_opens: 4,
            self.asks_for_a_pair: 2,
            self.uploads: 2,
        }
        while not until():
            [kind] = self.rng.choices(list(kinds), list(kinds.values()))
            try:
                await kind()
                self.seen[kind.__name__] += 1
            except (*_IN_TIME, httpx.HTTPError) as error:
                self.seen[f"{kind.__name__}: {_name_of(error)}"] += 1

    async def opened_call(self, channel: grpc.aio.Channel, **opening: Any) -> tuple[Any, Any]:
        call = depth_pb2_grpc.DepthServiceStub(channel).StreamDepth(metadata=self.metadata())
        await call.write(open_message(every=self.rng.random() < 0.5, **opening))
        answer = await asyncio.wait_for(call.read(), _PATIENCE_S)
        if answer is _EOF:
            raise DepthError(f"refused: {await call.details()}")
        self.opened += not answer.opened.resumed
        return call, answer.opened

    async def frames(self, call: Any, first: int = 1) -> None:
        for index in range(first, first + self.rng.randrange(1, 6)):
            await call.write(frame_message(make_frame(index)))
            if self.rng.random() < 0.8:
                await asyncio.wait_for(call.read(), _PATIENCE_S)

    async def ends(self) -> None:
        async with self.channel() as channel:
            call, _ = await self.opened_call(channel)
            await self.frames(call)
            await call.write(pb.StreamDepthRequest(end=pb.End()))
            while await asyncio.wait_for(call.read(), _PATIENCE_S) is not _EOF:
                pass

    async def cancels(self) -> None:
        async with self.channel() as channel:
            call, _ = await self.opened_call(channel)
            await self.frames(call)
            call.cancel()

    async def resumes(self) -> None:
        async with self.channel() as channel:
            call, opened = await self.opened_call(channel)
            await self.frames(call)
            call.cancel()
        async with self.channel() as channel:
            token = opened.resume_token
            call, _ = await self.opened_call(
                channel, stream_id=opened.stream_id, resume_token=token
            )
            await self.frames(call, first=100)

    async def is_closed_by_another(self) -> None:
        async with self.channel() as channel:
            call, opened = await self.opened_call(channel)
            await self.frames(call)
            stub = depth_pb2_grpc.DepthServiceStub(channel)
            question = pb.CloseStreamRequest(stream_id=opened.stream_id)
            await stub.CloseStream(question, metadata=self.metadata())

    async def sends_garbage(self) -> None:
        async with self.channel() as channel:
            call, _ = await self.opened_call(channel)
            await call.write(pb.StreamDepthRequest())
            await asyncio.wait_for(call.read(), _PATIENCE_S)

    async def uses_the_sdk(self) -> None:
        scheme = self.rng.choice(("grpc", "http"))
        address = self.grpc_address if scheme == "grpc" else self.http_address
        async with (
            DepthClient(
                f"{scheme}{'s' if _CA else ''}://{address}", token=self.token or None, ca=_CA
            ) as client,
            client.open_session(RIG, delivery=self.rng.choice(list(Delivery))) as session,
        ):
            self.opened += 1
            for index in range(1, 5):
                frame = make_frame(index)
                async with asyncio.timeout(_PATIENCE_S):
                    await session.step(frame.left, frame.right, Pose.identity())

    async def never_begins(self) -> None:
        async with self.channel() as channel:
            call = depth_pb2_grpc.DepthServiceStub(channel).StreamDepth(metadata=self.metadata())
            await asyncio.wait_for(call.read(), _PATIENCE_S)

    async def is_silent(self) -> None:
        async with self.channel() as channel:
            call, _ = await self.opened_call(channel)
            await call.write(pb.StreamDepthRequest(ping=pb.Ping()))
            while await asyncio.wait_for(call.read(), _PATIENCE_S) is not _EOF:
                pass

    async def does_not_read(self) -> None:
        async with self.channel() as channel:
            call, _ = await self.opened_call(channel, rig=StereoRig.from_rectified(LARGE))
            for index in range(1, 20):
                await asyncio.wait_for(
                    call.write(frame_message(make_frame(index, rig=LARGE))), _PATIENCE_S
                )
            await asyncio.sleep(self.rng.uniform(0, 6))
            call.cancel()

    async def dies(self) -> None:
        child = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "tests.support.soak_clients", self.grpc_address),
            env={**os.environ, **({"VERGENCE_TOKEN": self.token} if self.token else {})},
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.DEVNULL,
        )
        try:
            assert child.stdout is not None
            line = await asyncio.wait_for(child.stdout.readline(), 60)
            self.opened += line == b"opened\n"
            await asyncio.sleep(self.rng.uniform(0, 2))
            if self.rng.random() < 0.5:  # frozen first, as a headset that sleeps
                child.send_signal(signal.SIGSTOP)
                await asyncio.sleep(self.rng.uniform(0, 8))
        finally:
            child.kill()
            await child.wait()

    async def half_opens(self) -> None:
        address = self.rng.choice((self.grpc_address, self.http_address))
        host, _, port = address.rpartition(":")
        reader, writer = await asyncio.open_connection(host, int(port))
        writer.write(self.rng.choice((*_JUNK, os.urandom(50))))
        if self.rng.random() < 0.5:
            await asyncio.wait_for(reader.read(), _PATIENCE_S)  # until the server closes it
        writer.close()

    async def asks_for_a_pair(self) -> None:
        files = {name: (name, io.BytesIO(_png()), "image/png") for name in ("left", "right")}
        async with self.http() as http:
            answer = await http.post("/v1/pairs", files=files)
            self.seen[f"pair {answer.status_code}"] += 1

    async def uploads(self) -> None:
        if self.rng.random() < 0.3:  # and is lost half-way
            host, _, port = self.http_address.rpartition(":")
            _, writer = await asyncio.open_connection(host, int(port))
            writer.write(_POST + b"Content-Type: application/zip\r\n\r\n" + self.archive[:5000])
            await writer.drain()
            writer.close()
            return
        async with self.http() as http:
            answer = await http.post("/v1/sequences", content=self.archive, headers=ZIP)
            self.seen[f"upload {answer.status_code}"] += 1
            if answer.status_code == httpx.codes.ACCEPTED:
                where = f"/v1/sequences/{answer.json()['id']}"
                if self.rng.random() < 0.5:
                    await http.get(f"{where}/events")  # until it is done
                    await http.get(f"{where}/result")
                await http.delete(where)

    def metadata(self) -> tuple[tuple[str, str], ...]:
        return (("authorization", f"Bearer {self.token}"),) if self.token else ()

    def channel(self) -> grpc.aio.Channel:
        if _CA is None:
            return grpc.aio.insecure_channel(self.grpc_address, options=_OWN)
        credentials = grpc.ssl_channel_credentials(Path(_CA).read_bytes())
        return grpc.aio.secure_channel(self.grpc_address, credentials, options=_OWN)

    def http(self) -> httpx.AsyncClient:
        scheme, trusted = (
            ("https", ssl.create_default_context(cafile=_CA)) if _CA else ("http", None)
        )
        return httpx.AsyncClient(
            base_url=f"{scheme}://{self.http_address}",
            timeout=_PATIENCE_S,
            headers=dict(self.metadata()),
            verify=trusted or False,
        )


def _name_of(error: BaseException) -> str:
    return error.code().name if isinstance(error, grpc.aio.AioRpcError) else type(error).__name__


def _png() -> bytes:
    noise = np.random.default_rng(0).integers(0, 256, (RIG.height, RIG.width, 3), np.uint8)
    return cv2.imencode(".png", noise)[1].tobytes()


async def _stream_for_ever(address: str) -> None:
    scheme = "grpcs" if _CA else "grpc"
    async with (
        DepthClient(f"{scheme}://{address}", ca=_CA) as client,
        client.open_session(RIG) as session,
    ):
        print("opened", flush=True)  # noqa: T201  the parent reads it
        index = 0
        while True:
            index += 1
            frame = make_frame(index % 100 + 1)
            with suppress(DepthError):
                await session.step(frame.left, frame.right, Pose.identity())


async def _act(grpc_address: str, http_address: str, seed: int, seconds: float, count: int) -> None:
    rng = random.Random(seed)
    clients = [
        Clients(grpc_address, http_address, rng, _TOKENS[index % len(_TOKENS)])
        for index in range(count)
    ]
    ends_s = time.monotonic() + seconds
    await asyncio.gather(*(each.run(lambda: time.monotonic() > ends_s) for each in clients))
    seen = sum((each.seen for each in clients), Counter())
    opened = sum(each.opened for each in clients)
    print(json.dumps({"opened": opened, "seen": seen}))  # noqa: T201  as above


if __name__ == "__main__":
    if len(sys.argv) == 2:
        asyncio.run(_stream_for_ever(sys.argv[1]))
    else:
        where, (seed, seconds, count) = sys.argv[1:3], sys.argv[3:]
        asyncio.run(_act(where[0], where[1], int(seed), float(seconds), int(count)))
