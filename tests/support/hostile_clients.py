"""Clients that send hostile inputs over each transport, and two that behave, to be compared."""

import asyncio
import collections
import hashlib
import random
import secrets
import sys
import time
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from typing import Any, Self

import cv2
import grpc
import httpx
import numpy as np

from tests.support import hostile_inputs
from tests.support.frames import frame_message, make_frame, open_message
from tests.support.http import PROTOBUF
from vergence_proto import codec
from vergence_proto.geometry import Pose, RectifiedRig
from vergence_proto.http_records import CALL_ID_HEADER
from vergence_proto.types import ImageEncoding, PoseSample, StereoFrame, StereoRig
from vergence_proto.v1 import depth_pb2 as pb

OPENED = b"opened\n"  # the first line of a stream in a process of its own
Outcome = collections.Counter[str]

_DEPTH = "/vergence.v1.DepthService/"
_METHODS = (
    *(f"{_DEPTH}{name}" for name in ("GetServerInfo", "GetStream", "ResetStream", "CloseStream")),
    "/grpc.health.v1.Health/Check",
    "/grpc.nobody.knows/It",
)
_PATIENCE_S = 20.0
_UNLIMITED = (
    ("grpc.max_send_message_length", -1),
    ("grpc.max_receive_message_length", -1),
    ("grpc.use_local_subchannel_pool", 1),
)


class GrpcAttacker:
    """One connection; an open call lasts until the server ends it."""

    def __init__(self, address: str, seen: Outcome) -> None:
        self._address = address
        self._seen = seen
        self._call: Any = None
        self._frame_id = 0

    async def __aenter__(self) -> Self:
        self._channel = grpc.aio.insecure_channel(self._address, options=_UNLIMITED)
        self._connect: Any = self._channel.stream_stream  # without serialisers it speaks bytes
        self._ask: Any = self._channel.unary_unary
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        if self._call is not None:
            self._call.cancel()
        await self._channel.close(None)

    async def frame(self, chance: random.Random) -> None:
        """Send a frame on the open call, and read the answer."""
        if self._call is None:
            self._call = self._connect(f"{_DEPTH}StreamDepth")()
            await self._exchange(open_message(every=chance.random() < 0.5).SerializeToString())
            self._frame_id = 0
        if self._call is not None:
            self._frame_id += 1
            await self._exchange(hostile_inputs.frame(chance, self._frame_id))

    async def opening(self, data: bytes) -> None:
        """Send a first message on a call of its own, and leave."""
        kept, self._call = self._call, self._connect(f"{_DEPTH}StreamDepth")()
        with suppress(AttributeError):
            await self._exchange(data)
            self._call.cancel()
        self._call = kept

    async def method(self, chance: random.Random) -> None:
        """Call a unary method with bytes that are no request of it."""
        try:
            await self._ask(chance.choice(_METHODS))(
                hostile_inputs.message_of_any_kind(chance), timeout=_PATIENCE_S
            )
            self._seen["grpc: method answered"] += 1
        except grpc.aio.AioRpcError as error:
            self._seen[f"grpc: {error.code().name}"] += 1

    async def largest_step(self, width: int, height: int) -> None:
        """Ask for a step as large as the limits allow, with a frame of a few kilobytes."""
        requests = await asyncio.to_thread(hostile_inputs.flat_frame, width, height)
        kept, self._call = self._call, self._connect(f"{_DEPTH}StreamDepth")()
        for request in requests:
            if self._call is not None:
                await self._exchange(request.SerializeToString())
        if self._call is not None:
            self._call.cancel()
        self._call = kept

    async def _exchange(self, data: bytes) -> None:
        try:
            async with asyncio.timeout(_PATIENCE_S):
                await self._call.write(data)
                answer = await self._call.read()
            if not isinstance(answer, bytes):
                raise grpc.aio.UsageError  # the call has ended without an error
            response = pb.StreamDepthResponse.FromString(answer)
            kind = response.WhichOneof("message")
            reason = response.frame_error.reason if kind == "frame_error" else kind
            self._seen[f"grpc: {reason}"] += 1
            return
        except grpc.aio.AioRpcError as error:
            self._seen[f"grpc: {error.code().name}"] += 1
        except (asyncio.InvalidStateError, grpc.aio.UsageError):
            self._seen["grpc: call ended"] += 1
        except TimeoutError:
            self._seen["grpc: no answer"] += 1
            self._call.cancel()
        self._call = None


class HttpAttacker:
    """Requests over HTTP, and one open call for each client."""

    def __init__(self, address: str, seen: Outcome) -> None:
        self._url = f"http://{address}"
        self._seen = seen
        self._calls: dict[int, tuple[str, AsyncExitStack, asyncio.Task[None]]] = {}
        self._frame_ids: collections.Counter[int] = collections.Counter()

    async def __aenter__(self) -> Self:
        self._client = httpx.AsyncClient(timeout=60, trust_env=False)
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        for index in list(self._calls):
            await self._leave(index)
        await self._client.aclose()

    async def frame(self, chance: random.Random, index: int) -> None:
        """Send a frame to the open call of one client. Its answers are read and discarded."""
        if index not in self._calls:
            await self._open(index)
        if index not in self._calls:
            return
        self._frame_ids[index] += 1
        data = hostile_inputs.frame(chance, self._frame_ids[index])
        path = f"/v1/streams/{self._calls[index][0]}"
        if await self._post(path, content=data, headers=PROTOBUF) != httpx.codes.NO_CONTENT:
            await self._leave(index)

    async def opening(self, data: bytes) -> None:
        with suppress(httpx.HTTPError):
            async with self._client.stream(
                "POST", f"{self._url}/v1/streams", content=data, headers=PROTOBUF
            ) as got:
                self._seen[f"http: {got.status_code}"] += 1

    async def method(self, chance: random.Random) -> None:
        name = chance.choice(("GetServerInfo", "GetStream", "CloseStream", "x" * 200))
        data = hostile_inputs.message_of_any_kind(chance)
        await self._post(f"/v1/methods/{name}", content=data, headers=PROTOBUF)

    async def pair(self, files: dict[str, bytes]) -> None:
        await self._post("/v1/pairs", files=files)

    async def archive(self, media_type: str, data: bytes) -> None:
        """Upload an archive; if its sequence is accepted, delete it again."""
        with suppress(httpx.HTTPError):
            answer = await self._client.post(
                f"{self._url}/v1/sequences", content=data, headers={"content-type": media_type}
            )
            self._seen[f"http: {answer.status_code}"] += 1
            if answer.status_code == httpx.codes.ACCEPTED:
                await self._client.delete(f"{self._url}/v1/sequences/{answer.json()['id']}")

    async def _open(self, index: int) -> None:
        stack = AsyncExitStack()
        data = open_message(every=False).SerializeToString()
        try:
            answer = await stack.enter_async_context(
                self._client.stream(
                    "POST", f"{self._url}/v1/streams", content=data, headers=PROTOBUF
                )
            )
        except httpx.HTTPError:
            return
        if CALL_ID_HEADER not in answer.headers:
            await stack.aclose()
            return
        reading = asyncio.create_task(_discarded(answer))
        self._calls[index] = (answer.headers[CALL_ID_HEADER], stack, reading)
        self._frame_ids[index] = 0

    async def _leave(self, index: int) -> None:
        _, stack, reading = self._calls.pop(index)
        reading.cancel()
        await asyncio.gather(reading, return_exceptions=True)
        await stack.aclose()

    async def _post(self, path: str, **body: Any) -> int:
        try:
            answer = await self._client.post(f"{self._url}{path}", **body)
        except httpx.HTTPError as error:
            self._seen[f"http: {type(error).__name__}"] += 1
            return 0
        self._seen[f"http: {answer.status_code}"] += 1
        return answer.status_code


async def _discarded(answer: httpx.Response) -> None:
    with suppress(httpx.HTTPError):
        async for _ in answer.aiter_bytes():
            pass


class ZenohAttacker:
    """Samples and queries of a client that does not keep to the rules."""

    def __init__(self, session: Any, seen: Outcome) -> None:
        self._session = session
        self._seen = seen
        self._streams: dict[int, tuple[str, str, Any]] = {}
        self._frame_ids: collections.Counter[int] = collections.Counter()

    async def frame(self, chance: random.Random, index: int) -> None:
        await asyncio.to_thread(self._frame, chance, index)

    async def query(self, chance: random.Random) -> None:
        what = chance.choice(("open", "info", "stream", "close", "nothing"))
        data = hostile_inputs.message_of_any_kind(chance)
        await asyncio.to_thread(self._get, what, data, secrets.token_hex(4))

    def _frame(self, chance: random.Random, index: int) -> None:
        from vergence_proto.zenoh.keys import encoding_of

        if index not in self._streams or chance.random() < 0.02:
            self._open(index)
        if index not in self._streams:
            return
        stream_id, attachment_id, _ = self._streams[index]
        self._frame_ids[index] += 1
        request = hostile_inputs.frame(chance, self._frame_ids[index])
        # The frame by itself, without the first bytes that make it a request of gRPC.
        data = request[3:] if chance.random() < 0.9 else request
        self._session.put(
            f"vergence/v1/{stream_id}/frames",
            data,
            encoding=encoding_of(pb.Frame()),
            attachment=attachment_id,
        )
        self._seen["zenoh: frame sent"] += 1

    def _open(self, index: int) -> None:
        if index in self._streams:
            self._streams.pop(index)[2].undeclare()  # the server notices that its client has left
        stream_id, attachment_id = f"hostile-{index}", secrets.token_hex(8)
        token = self._session.liveliness().declare_token(
            f"vergence/v1/{stream_id}/@client/{attachment_id}"
        )
        data = open_message(stream_id, every=False).open.SerializeToString()
        if self._get("open", data, attachment_id):
            self._streams[index] = (stream_id, attachment_id, token)
            self._frame_ids[index] = 0
        else:
            token.undeclare()

    def _get(self, what: str, data: bytes, attachment_id: str) -> bool:
        key = f"vergence/v1/@server/*/{what}"
        replies = self._session.get(key, payload=data, attachment=attachment_id, timeout=5.0)
        accepted = False
        for reply in replies:
            accepted = reply.ok is not None
            self._seen[f"zenoh: {what} {'answered' if accepted else 'refused'}"] += 1
        return accepted


@asynccontextmanager
async def zenoh_attacker(
    endpoint: str | None, seen: Outcome
) -> AsyncIterator[ZenohAttacker | None]:
    """Connect to the server, or yield None if Zenoh is not installed."""
    if endpoint is None:
        yield None
        return
    import zenoh

    from vergence_proto.zenoh.session import make_config

    config = make_config(max_message_bytes=1 << 26, mode="client", connect__endpoints=[endpoint])
    session = await asyncio.to_thread(zenoh.open, config)
    try:
        yield ZenohAttacker(session, seen)
    finally:
        await asyncio.to_thread(session.close)


async def neighbour_stream(address: str) -> dict[str, Any]:
    """Send lossless frames until the standard input ends; return a digest of each answer."""
    digests: list[str] = []
    async with grpc.aio.insecure_channel(address, options=_UNLIMITED) as channel:
        connect: Any = channel.stream_stream
        call = connect(f"{_DEPTH}StreamDepth")()
        await call.write(open_message(every=True, sigma=True).SerializeToString())
        await _opened(call)
        stopping = asyncio.create_task(asyncio.to_thread(sys.stdin.read))
        while not stopping.done():
            request = frame_message(make_frame(len(digests) + 1, brightness=len(digests) % 7 + 40))
            await call.write(request.SerializeToString())
            answer = await _map_of(call)
            content = answer.disparity.data + answer.sigma.data + answer.confidence.data
            digests.append(hashlib.sha256(content).hexdigest()[:16])
            await asyncio.sleep(0.05)
        call.cancel()
    return {"answers": digests}


async def _opened(call: Any) -> None:
    """Wait until the stream is open, and say so."""
    assert pb.StreamDepthResponse.FromString(await call.read()).HasField("opened")
    sys.stdout.buffer.write(OPENED)
    sys.stdout.flush()


async def _map_of(call: Any) -> pb.DisparityMap:
    """Return the next map; notices may come before it."""
    while True:
        response = pb.StreamDepthResponse.FromString(await call.read())
        if response.HasField("disparity"):
            return response.disparity
        assert response.HasField("notice"), response


async def healthy_stream(address: str) -> dict[str, Any]:
    """Send 640x480 at 30 Hz, live and within the credit, until the standard input ends."""
    rig = RectifiedRig(640, 480, 500.0, 500.0, 319.5, 319.5, 239.5, 0.1)
    noise = np.random.default_rng(0).integers(0, 256, (480, 640 + 12, 3), np.uint8)
    wall = cv2.GaussianBlur(noise, (0, 0), 1.5).astype(np.uint8)
    left, right = (np.ascontiguousarray(wall[:, at : at + 640]) for at in (0, 12))
    ages_ms: list[float] = []
    waiting: set[int] = set()
    async with grpc.aio.insecure_channel(address, options=_UNLIMITED) as channel:
        connect: Any = channel.stream_stream
        call = connect(f"{_DEPTH}StreamDepth")()
        opening = open_message(every=False, rig=StereoRig.from_rectified(rig))
        await call.write(opening.SerializeToString())
        await _opened(call)

        async def read() -> None:
            while isinstance(data := await call.read(), bytes):
                response = pb.StreamDepthResponse.FromString(data)
                answer = response.disparity
                if response.HasField("disparity"):
                    ages_ms.append((time.monotonic_ns() - answer.capture_ns) / 1e6)
                waiting.difference_update([answer.frame_id, response.frame_error.frame_id])
                waiting.difference_update(response.frames_dropped.frame_ids)

        reading = asyncio.create_task(read())
        stopping = asyncio.create_task(asyncio.to_thread(sys.stdin.read))
        started_s, index = time.monotonic(), 0
        while not stopping.done():
            index += 1
            await asyncio.sleep(max(0.0, started_s + index / 30 - time.monotonic()))
            if len(waiting) < 2:
                waiting.add(index)
                pose = PoseSample(Pose.identity())
                frame = StereoFrame(index, time.monotonic_ns(), left, right, pose)
                await call.write(codec.frame_to_request(frame, encoding=ImageEncoding.RAW))
        seconds = time.monotonic() - started_s
        reading.cancel()
        call.cancel()
    return {
        "fps": round(len(ages_ms) / seconds, 1),
        "p50_ms": round(float(np.percentile(ages_ms, 50)), 1),
        "p99_ms": round(float(np.percentile(ages_ms, 99)), 1),
        "max_ms": round(max(ages_ms), 1),
    }
