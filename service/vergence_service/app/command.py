"""Run the server as a command: settings, logging, and errors in one line."""

import asyncio
import logging
import os
import sys
import threading
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from vergence_proto.model_io import ManifestError
from vergence_service.app.security import check_exposure
from vergence_service.app.server import Running, serve
from vergence_service.inference.installed import ProviderUnavailable
from vergence_service.process.descriptors import raise_descriptor_limit
from vergence_service.process.logs import start_logging
from vergence_service.process.malloc import keep_freed_memory, save_address_space
from vergence_service.settings import SettingsError, load_settings
from vergence_service.transports.errors import ExtraMissing, PortTaken, ZenohUnreachable

log = logging.getLogger(__name__)

# Errors that an operator can fix. They are reported in one line, without a traceback.
_OPERATOR_ERRORS = (
    SettingsError,
    ManifestError,
    ProviderUnavailable,
    PortTaken,
    ExtraMissing,
    ZenohUnreachable,
    FileNotFoundError,
)


def run_server(
    flags: Mapping[str, Any], *, config: Path | None, print_config: bool, until_eof: bool = False
) -> None:
    """Serve until a signal, or print the settings. An operator's error is exit code 2.

    ``flags`` are settings by key; None is a flag that was not given. ``until_eof``: the end of the
    standard input stops the server too, so that it does not outlive the program that started it.
    """
    try:
        settings = load_settings(
            config=config, flags={key: value for key, value in flags.items() if value is not None}
        )
        if print_config:
            sys.stdout.write(settings.to_toml())
            return
        os.umask(0o077)  # what clients send is for nobody else on this machine
        check_exposure(settings)
        start_logging(settings.log_level, form=settings.log_format)
        save_address_space()
        keep_freed_memory()
        raise_descriptor_limit()
        ending = partial(_end_after, 2 * settings.server.drain_s)
        asyncio.run(serve(settings, on_serving=_announce, on_stopping=ending, until_eof=until_eof))
    except MemoryError as error:
        _fail(str(error) or "the process has no memory left; raise its limits (ulimit -v)")
    except _OPERATOR_ERRORS as error:
        _fail(str(error))
    except RuntimeError as error:
        if "can't start new thread" not in str(error):
            raise
        _fail("the process can start no more threads; raise its limits (ulimit -u, ulimit -v)")


def _fail(why: str) -> NoReturn:
    sys.stderr.write(f"vergence serve: {why}\n")
    raise SystemExit(2) from None


def _end_after(seconds: float) -> None:
    """End the process after this time, whatever it does then.

    By then, answers are sent and jobs have kept their progress. But work in a thread cannot be
    stopped, for example a step of a large image, and Python waits for its threads.
    """

    def end() -> None:
        log.warning("the server did not end in %g s, twice server.drain_s; it ends now", seconds)
        logging.shutdown()
        os._exit(0)

    timer = threading.Timer(seconds, end)
    timer.daemon = True  # it must not keep the process that it is there to end
    timer.start()


def _announce(server: Running) -> None:
    zenoh = f" zenoh={server.zenoh.endpoint}" if server.zenoh else ""
    _say(f"listening grpc={server.grpc_address} http={server.http_address}{zenoh}")
    server.loading.add_done_callback(partial(_announce_ready, server.admin_address))


def _announce_ready(admin_address: str, loading: asyncio.Task[None]) -> None:
    if not loading.cancelled() and loading.exception() is None:
        _say(f"ready: every graph is loaded; admin={admin_address}")


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()
