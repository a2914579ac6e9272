"""The command ``vergence serve``, also ``python -m vergence_service``."""

import asyncio
import logging
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from vergence_proto.model_io import ManifestError
from vergence_service.app.server import Running
from vergence_service.app.server import serve as serve_until_stopped
from vergence_service.inference.providers import ProviderUnavailable
from vergence_service.malloc import keep_freed_memory
from vergence_service.settings import SettingsError, load_settings
from vergence_service.transports.errors import ExtraMissing, PortTaken, ZenohUnreachable

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


def serve(
    config: Annotated[Path | None, typer.Option(help="Settings as a TOML file.")] = None,
    print_config: Annotated[
        bool, typer.Option("--print-config", help="Print the settings as TOML and exit.")
    ] = False,
    grpc_port: Annotated[int | None, typer.Option(help="Port of gRPC; 0 picks a free one.")] = None,
    http_port: Annotated[int | None, typer.Option(help="Port of HTTP; 0 picks a free one.")] = None,
    host: Annotated[
        str | None, typer.Option(help="Address that every transport listens on.")
    ] = None,
    zenoh: Annotated[
        bool | None, typer.Option("--zenoh/--no-zenoh", help="Serve over Zenoh too.")
    ] = None,
    model: Annotated[str | None, typer.Option(help="Model of the manifest.")] = None,
    weights: Annotated[Path | None, typer.Option(help="Folder with a manifest.")] = None,
    threads: Annotated[
        int | None, typer.Option(help="Threads of all steps; 0 uses one per core.")
    ] = None,
) -> None:
    """Serve depth over gRPC, HTTP and, with --zenoh, Zenoh.

    Every setting is also an environment variable (VERGENCE_GRPC__PORT) and a key of the file;
    --print-config lists them. Flags win over variables, and variables over the file. When the
    server is ready, it prints one line: "listening grpc=HOST:PORT http=HOST:PORT", and with Zenoh
    also " zenoh=ENDPOINT".
    """
    flags: dict[str, Any] = {
        "grpc.port": grpc_port,
        "http.port": http_port,
        # A flag wins over the file, whichever of these the file sets.
        **dict.fromkeys(("server.host", "grpc.host", "http.host", "zenoh.host"), host),
        "zenoh.enabled": zenoh,
        "model.name": model,
        "model.weights": weights,
        "model.threads": threads,
    }
    try:
        settings = load_settings(
            config=config, flags={key: value for key, value in flags.items() if value is not None}
        )
        if print_config:
            typer.echo(settings.to_toml(), nl=False)
            return
        logging.basicConfig(
            level=settings.log_level.upper(),
            format="%(asctime)s %(levelname)s %(name)s %(message)s",
        )
        keep_freed_memory()
        asyncio.run(serve_until_stopped(settings, on_serving=_announce))
    except _OPERATOR_ERRORS as error:
        typer.echo(f"vergence serve: {error}", err=True)
        raise typer.Exit(2) from None


def _announce(server: Running) -> None:
    zenoh = f" zenoh={server.zenoh.endpoint}" if server.zenoh else ""
    typer.echo(f"listening grpc={server.grpc_address} http={server.http_address}{zenoh}")
    sys.stdout.flush()


if __name__ == "__main__":
    typer.run(serve)
