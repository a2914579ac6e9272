"""``vergence serve``, and the same as ``python -m vergence_service``."""

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

# What an operator can mend: told in one line, without a trace.
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
        bool, typer.Option("--print-config", help="Print the settings as TOML, and end.")
    ] = False,
    grpc_port: Annotated[int | None, typer.Option(help="0: a free one.")] = None,
    http_port: Annotated[int | None, typer.Option(help="0: a free one.")] = None,
    host: Annotated[str | None, typer.Option(help="To listen on, for all.")] = None,
    zenoh: Annotated[
        bool | None, typer.Option("--zenoh/--no-zenoh", help="Serve over Zenoh too.")
    ] = None,
    model: Annotated[str | None, typer.Option(help="A model of the manifest.")] = None,
    weights: Annotated[Path | None, typer.Option(help="A folder with a manifest.")] = None,
    threads: Annotated[int | None, typer.Option(help="Of one step; 0: one a core.")] = None,
) -> None:
    """Serve depth over gRPC, and over Zenoh if asked; health and metrics over HTTP.

    Every setting is also a variable (VERGENCE_GRPC__PORT) and a key of the file; --print-config
    lists them. Flags win over variables, those over the file. Once it serves, one line on
    standard output tells the addresses: "listening grpc=HOST:PORT http=HOST:PORT", and
    with Zenoh " zenoh=ENDPOINT".
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
