"""The same client for programs without an event loop: every call waits for its answer.

The loop runs in one background thread, which the client's ``with`` starts and ends. Methods are
those of :mod:`vergence.client` and :mod:`vergence.session`, with the same arguments and errors.
"""

import asyncio
import functools
import threading
from collections.abc import Callable, Coroutine
from typing import Any, Concatenate, Generic, ParamSpec, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from vergence.client import DEFAULT_SERVER, DepthClient
from vergence.info import ModelInfo
from vergence.results import DepthResult, Drops
from vergence.session import DepthSession
from vergence_proto.geometry import RectifiedRig
from vergence_proto.types import Delivery, StereoRig

Inner = TypeVar("Inner")
Value = TypeVar("Value")
Args = ParamSpec("Args")


def depth(
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    rig: StereoRig | RectifiedRig,
    *,
    server: str = DEFAULT_SERVER,
    iterations: int = 0,
) -> DepthResult:
    """Depth of one pair, alone: a stream is opened, stepped cold, and ended.

    Images are uint8, [H, W] or [H, W, 3] RGB; ``iterations`` are those of the cold start (0: the
    server's default). Raises what :class:`~vergence.DepthSession` raises.
    """
    with (
        BlockingClient(server) as client,
        client.open_session(rig, delivery=Delivery.EVERY, cold_iterations=iterations) as session,
    ):
        return session.step(left, right)


class _LoopThread:
    """An event loop in a thread, between :meth:`start` and :meth:`stop`."""

    def start(self) -> None:
        started = threading.Event()
        # Not a daemon: it ends because stop() says so, and never in the middle of something.
        self._thread = threading.Thread(target=self._main, args=(started,), name="vergence-client")
        self._thread.start()
        started.wait()

    def _main(self, started: threading.Event) -> None:
        with asyncio.Runner() as runner:  # on leaving it cancels and awaits what is left
            self._loop = runner.get_loop()
            self._loop.call_soon(started.set)
            self._loop.run_forever()

    def stop(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()

    def wait(self, work: Coroutine[Any, Any, Value]) -> Value:
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result()
        except BaseException:  # an interrupt: what nobody waits for any more is called off
            future.cancel()
            raise


class _Blocking(Generic[Inner]):
    def __init__(self, inner: Inner, loop: _LoopThread) -> None:
        self._inner = inner
        self._loop = loop


def _waiting(
    method: Callable[Concatenate[Inner, Args], Coroutine[Any, Any, Value]],
) -> Callable[Concatenate[_Blocking[Inner], Args], Value]:
    """The blocking form of a coroutine method."""

    @functools.wraps(method)
    def call(self: _Blocking[Inner], /, *args: Args.args, **kwargs: Args.kwargs) -> Value:
        return self._loop.wait(method(self._inner, *args, **kwargs))

    return call


def _on_loop(
    method: Callable[Concatenate[Inner, Args], Value],
) -> Callable[Concatenate[_Blocking[Inner], Args], Value]:
    """The same method, run in the loop's thread: a session is not to be touched from another."""

    @functools.wraps(method)
    def call(self: _Blocking[Inner], /, *args: Args.args, **kwargs: Args.kwargs) -> Value:
        async def run() -> Value:
            return method(self._inner, *args, **kwargs)

        return self._loop.wait(run())

    return call


class BlockingSession(_Blocking[DepthSession]):
    """A :class:`~vergence.DepthSession` whose ``step`` returns and whose iteration is ``for``."""

    def __enter__(self) -> Self:
        self._loop.wait(self._inner.__aenter__())
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._loop.wait(self._inner.__aexit__(*exc_info))

    submit = _on_loop(DepthSession.submit)
    step = _waiting(DepthSession.step)
    reset = _on_loop(DepthSession.reset)
    end = _on_loop(DepthSession.end)

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> DepthResult:
        try:
            return self._loop.wait(self._inner.__anext__())
        except StopAsyncIteration:
            raise StopIteration from None

    @property
    def stream_id(self) -> str:
        return self._inner.stream_id

    @property
    def resume_token(self) -> bytes:
        return self._inner.resume_token

    @property
    def rig(self) -> RectifiedRig:
        return self._inner.rig

    @property
    def model(self) -> ModelInfo:
        return self._inner.model

    @property
    def credit(self) -> int:
        return self._inner.credit

    @property
    def drops(self) -> Drops:
        return self._inner.drops

    @property
    def round_trip_s(self) -> float | None:
        return self._inner.round_trip_s


def _session(
    method: Callable[Concatenate[DepthClient, Args], DepthSession],
) -> Callable[Concatenate["BlockingClient", Args], BlockingSession]:
    @functools.wraps(method)
    def call(self: "BlockingClient", /, *args: Args.args, **kwargs: Args.kwargs) -> BlockingSession:
        return BlockingSession(method(self._inner, *args, **kwargs), self._loop)

    return call


class BlockingClient(_Blocking[DepthClient]):
    """A :class:`~vergence.DepthClient` with its own event loop; use it inside ``with``.

    Callbacks given as ``on_event`` run in the loop's thread.
    """

    def __init__(self, server: str = DEFAULT_SERVER) -> None:
        super().__init__(DepthClient(server), _LoopThread())

    def __enter__(self) -> Self:
        self._loop.start()
        try:
            self._loop.wait(self._inner.__aenter__())
        except BaseException:
            self._loop.stop()
            raise
        return self

    def __exit__(self, *exc_info: object) -> None:
        try:
            self._loop.wait(self._inner.__aexit__(*exc_info))
        finally:
            self._loop.stop()

    open_session = _session(DepthClient.open_session)
    server_info = _waiting(DepthClient.server_info)
    stream_info = _waiting(DepthClient.stream_info)
    close_stream = _waiting(DepthClient.close_stream)
