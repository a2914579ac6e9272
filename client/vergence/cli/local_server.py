"""A server of one's own, for as long as a command runs."""

import asyncio
import importlib.util
import os
import re
import sys
import tempfile
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager, suppress
from typing import IO, Literal

from vergence.cli.errors import Trouble

_READY = re.compile(r"listening grpc=(\S+) http=(\S+)")
_START_TIMEOUT_S = 60.0  # loading and warming a model up takes seconds on a small machine
_STOP_TIMEOUT_S = 15.0


@asynccontextmanager
async def local_server(
    arguments: Sequence[str] = (), *, scheme: Literal["grpc", "http"] = "grpc"
) -> AsyncIterator[str]:
    """Start ``python -m vergence_service`` on free ports; yields ``SCHEME://HOST:PORT``.

    Raises Trouble: it is not installed, or does not come up; with its last words.
    """
    if importlib.util.find_spec("vergence_service") is None:
        raise Trouble(
            "the server is not installed here; install it with: pip install 'vergence[server]', "
            "or name a running one with --server HOST:PORT"
        )
    with (
        tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as log,
        tempfile.TemporaryDirectory() as jobs,  # not the folder of a server that runs already
    ):
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "vergence_service"),
            *("--grpc-port", "0", "--http-port", "0"),
            *arguments,
            env={**os.environ, "VERGENCE_BATCH__DIRECTORY": jobs},
            stdout=asyncio.subprocess.PIPE,
            stderr=log,
        )
        try:
            yield f"{scheme}://{(await _addresses(process, log))[scheme]}"
        finally:
            await _stop(process)


async def _addresses(process: asyncio.subprocess.Process, log: IO[str]) -> dict[str, str]:
    assert process.stdout is not None
    try:
        async with asyncio.timeout(_START_TIMEOUT_S):
            async for line in process.stdout:
                if ready := _READY.search(line.decode("utf-8", "replace")):
                    return {"grpc": ready[1], "http": ready[2]}
    except TimeoutError:
        raise Trouble(_last_words(f"not ready within {_START_TIMEOUT_S:g} s", log)) from None
    code = await process.wait()
    raise Trouble(_last_words(f"exited with code {code}", log))


def _last_words(what: str, log: IO[str]) -> str:
    log.seek(0)
    lines = [line for line in log.read().splitlines() if line.strip()]
    return "\n  ".join([f"the server did not start: {what}", *lines[-5:]])


async def _stop(process: asyncio.subprocess.Process) -> None:
    """Ask it to drain, and insist if it does not."""
    with suppress(ProcessLookupError):
        process.terminate()
    try:
        await asyncio.wait_for(process.wait(), _STOP_TIMEOUT_S)
    except TimeoutError:
        process.kill()
        await process.wait()
