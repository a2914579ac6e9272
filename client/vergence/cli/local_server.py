"""A server process that lives as long as a command."""

import asyncio
import importlib.util
import os
import re
import sys
import tempfile
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager, suppress
from typing import IO, Literal

from rich.console import Console

from vergence.cli.errors import CliError
from vergence.client import DepthClient
from vergence.transports.addresses import DEFAULT_SERVER
from vergence_proto.errors import DepthError
from vergence_proto.extras import how_to_install

_LISTENING = re.compile(r"listening grpc=(\S+) http=(\S+)")
_READY = "ready"
_START_TIMEOUT_S = 60.0  # loading and warming a model up takes seconds on a small machine
_STOP_TIMEOUT_S = 15.0

# Every server accepts images of this size. Larger ones need room: two images of three bytes a
# pixel in a message, and the state of a stream.
_USUAL_PIXELS = 4_000_000
_BYTES_A_PIXEL = 7
_STATE_BYTES_A_PIXEL = 64
_LOOK_S = 1.0


@asynccontextmanager
async def local_server(
    arguments: Sequence[str] = (),
    *,
    scheme: Literal["grpc", "http"] = "grpc",
    pixels: int = 0,
) -> AsyncIterator[str]:
    """Start ``python -m vergence_service`` on free ports; yields ``SCHEME://HOST:PORT``.

    The limits of images leave room for ``pixels``, unless the environment sets them.

    Raises CliError: the server is not installed or does not start; its last lines are quoted.
    """
    if importlib.util.find_spec("vergence_service") is None:
        raise CliError(
            f"the server is not installed here; install it with: {how_to_install('server')}, "
            "or name a running one with --server HOST:PORT"
        )
    with (
        tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as log,
        tempfile.TemporaryDirectory() as jobs,  # another server may use the default folder
    ):
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "vergence_service"),
            # Whatever the environment sets, only this command reaches this server, and the server
            # ends with it: even one that is killed closes its end of the pipe.
            *("--grpc-port", "0", "--http-port", "0", "--host", "127.0.0.1", "--no-zenoh"),
            "--until-eof",
            *arguments,
            env={**settings_for(pixels), **os.environ, "VERGENCE_BATCH__DIRECTORY": jobs},
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            stderr=log,
        )
        try:
            yield f"{scheme}://{(await _addresses(process, log))[scheme]}"
        finally:
            await _stop(process)


def settings_for(pixels: int) -> dict[str, str]:
    """Return settings for images that are larger than a server of others accepts."""
    if pixels <= _USUAL_PIXELS:
        return {}
    frame_mib = 1 + _BYTES_A_PIXEL * pixels // (1 << 20)
    state_mib = 1 + _STATE_BYTES_A_PIXEL * pixels // (1 << 20)
    return {
        "VERGENCE_LIMITS__MAX_PIXELS": str(pixels),
        "VERGENCE_LIMITS__MAX_FRAME_MIB": str(frame_mib),
        "VERGENCE_LIMITS__MAX_STATE_MIB": str(state_mib),
    }


@asynccontextmanager
async def server_for(
    server: str | None, console: Console, *, pixels: int = 0
) -> AsyncIterator[str]:
    """Yield ``server``, or the address of a local server for the length of the block.

    A local server accepts images of ``pixels``.
    """
    if server is not None:
        yield server
        return
    if await _answers(DEFAULT_SERVER):
        place = DEFAULT_SERVER.partition("://")[2]
        console.print(f"[dim]a server answers at {place}; to use it, add --server {place}[/]")
    with console.status("starting a server") as status:
        async with local_server(pixels=pixels) as address:
            status.stop()
            yield address
            status.update("stopping the server")
            status.start()


async def _answers(server: str) -> bool:
    """Check for a server that is started already: two share the cores, and both get slow."""
    try:
        async with asyncio.timeout(_LOOK_S), DepthClient(server) as client:
            await client.server_info()
    except (DepthError, TimeoutError):
        return False
    return True


async def _addresses(process: asyncio.subprocess.Process, log: IO[str]) -> dict[str, str]:
    assert process.stdout is not None
    try:
        async with asyncio.timeout(_START_TIMEOUT_S):
            found: dict[str, str] = {}
            async for line in process.stdout:
                text = line.decode("utf-8", "replace")
                if listening := _LISTENING.search(text):
                    found = {"grpc": listening[1], "http": listening[2]}
                # Until then the first lossless frame would wait, and its time would say nothing.
                if found and text.startswith(_READY):
                    return found
    except TimeoutError:
        raise CliError(_last_words(f"not ready within {_START_TIMEOUT_S:g} s", log)) from None
    code = await process.wait()
    raise CliError(_last_words(f"exited with code {code}", log))


def _last_words(what: str, log: IO[str]) -> str:
    log.seek(0)
    lines = [line for line in log.read().splitlines() if line.strip()]
    return "\n  ".join([f"the server did not start: {what}", *lines[-5:]])


async def _stop(process: asyncio.subprocess.Process) -> None:
    """Ask the server to drain, and kill it if it does not end."""
    assert process.stdin is not None
    process.stdin.close()  # the end of its input; on Windows, terminate() would kill it
    if sys.platform != "win32":
        with suppress(ProcessLookupError):
            process.terminate()
    try:
        await asyncio.wait_for(process.wait(), _STOP_TIMEOUT_S)
    except TimeoutError:
        process.kill()
        await process.wait()
