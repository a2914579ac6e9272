"""The command ``vergence serve``, also ``python -m vergence_service``.

The server is imported when it starts: ``vergence --help`` lists this command without it.
"""

from pathlib import Path
from typing import Annotated, Any

import typer

from vergence_proto.extras import how_to_install


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
    tokens: Annotated[
        Path | None, typer.Option(help="File of tokens, of vergence token; clients need one.")
    ] = None,
    tls_cert: Annotated[Path | None, typer.Option(help="PEM file with the certificate.")] = None,
    tls_key: Annotated[Path | None, typer.Option(help="PEM file with its key.")] = None,
    insecure: Annotated[
        bool | None,
        typer.Option("--insecure", help="Listen beyond this machine without TLS or credentials."),
    ] = None,
    model: Annotated[str | None, typer.Option(help="Model of the manifest.")] = None,
    weights: Annotated[Path | None, typer.Option(help="Folder with a manifest.")] = None,
    threads: Annotated[
        int | None, typer.Option(help="Threads of all steps; 0 uses one per core.")
    ] = None,
    until_eof: Annotated[
        bool, typer.Option("--until-eof", help="Stop when the standard input ends.")
    ] = False,
) -> None:
    """Serve depth over gRPC, HTTP and, with --zenoh, Zenoh.

    Every setting is also an environment variable (VERGENCE_GRPC__PORT) and a key of the file;
    --print-config lists them. Flags win over variables, and variables over the file. When live
    streams are served, it prints one line: "listening grpc=HOST:PORT http=HOST:PORT", with Zenoh
    also " zenoh=ENDPOINT". Lossless streams, pairs and sequences then wait for the larger graphs
    that they need, until it prints "ready" and the address for administrators.
    """
    flags: dict[str, Any] = {
        "grpc.port": grpc_port,
        "http.port": http_port,
        # A flag wins over the file, whichever of these the file sets.
        **dict.fromkeys(("server.host", "grpc.host", "http.host", "zenoh.host"), host),
        "zenoh.enabled": zenoh,
        "security.tokens": tokens,
        "security.tls_cert": tls_cert,
        "security.tls_key": tls_key,
        "security.insecure": insecure,
        "model.name": model,
        "model.weights": weights,
        "model.threads": threads,
    }
    if not print_config:
        typer.echo(
            "vergence serve: starting", err=True
        )  # the imports take seconds on slow machines
    try:
        from vergence_service.app.command import run_server
    except ModuleNotFoundError as error:
        hint = f"needs {error.name}, which is not installed; install it: {how_to_install('server')}"
        typer.echo(f"vergence serve {hint}", err=True)
        raise typer.Exit(1) from None
    run_server(flags, config=config, print_config=print_config, until_eof=until_eof)


if __name__ == "__main__":
    program = typer.Typer(
        add_completion=False,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    program.command()(serve)
    program()
