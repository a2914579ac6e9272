"""The commands of ``vergence`` and their options."""

import asyncio
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from vergence.cli.batch import batch
from vergence.cli.demo import bundled_sample, demo
from vergence.cli.doctor import doctor
from vergence.cli.errors import CliError
from vergence.cli.run import run
from vergence.client import DEFAULT_SERVER, DepthClient
from vergence_proto.errors import DepthError
from vergence_proto.jobs import Output, ResultFormat

app = typer.Typer(
    help="Live stereo depth over the network.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

# What other installed packages contribute is loaded when it is called, and not before: a server's
# imports would otherwise slow every command down, or break it where they are missing.
_CONTRIBUTED = "vergence.commands"
_ABOUT = {"serve": "Serve depth over gRPC, with health and metrics over HTTP."}


JsonOption = Annotated[
    Path | None, typer.Option("--json", help="Write the figures of the table to this file.")
]


def run_program() -> None:
    """Run the command line; trouble is one line on stderr and the exit code."""
    try:
        app()
    except (CliError, DepthError, OSError) as error:  # OSError: a file that cannot be written
        Console(stderr=True, soft_wrap=True, highlight=False).print(
            f"vergence: {error}", style="red", markup=False
        )
        raise SystemExit(getattr(error, "exit_code", 1)) from None


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"vergence {metadata.version('vergence')}")
        raise typer.Exit


def _checked_server(server: str | None) -> str | None:
    if server is not None:
        try:
            DepthClient(server)
        except ValueError as error:
            raise typer.BadParameter(str(error)) from None
    return server


@app.callback()
def _vergence(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Show it.")
    ] = False,
) -> None: ...


@app.command("demo")
def _demo(
    frames: Annotated[int | None, typer.Option(min=1, help="Stop after so many.")] = None,
    source: Annotated[str | None, typer.Option(help="Another KIND:PATH than the sample.")] = None,
    out: Annotated[Path, typer.Option(help="Where the pictures go.")] = Path("vergence-demo"),
    json: JsonOption = None,
) -> None:
    """Stream a sample through a server of its own, and show what comes of it."""
    text = source or bundled_sample()
    asyncio.run(demo(text, frames=frames, out=out, json=json, console=Console()))


@app.command("run")
def _run(
    source: Annotated[str, typer.Argument(help="KIND:PATH, as vergence:DIR or kitti:DIR.")],
    server: Annotated[
        str | None,
        typer.Option(
            help="HOST:PORT or zenoh://HOST:PORT of a running server; else one is started.",
            callback=_checked_server,
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Where disparity goes (default: vergence-run/NAME).")
    ] = None,
    rate: Annotated[
        str,
        typer.Option(help="max: every frame, losslessly. HZ or source: live, the newest win."),
    ] = "max",
    iterations: Annotated[
        int, typer.Option(min=0, help="Refinements a frame; 0: the server's default.")
    ] = 0,
    pictures: Annotated[bool, typer.Option("--pictures", help="Write a sheet to look at.")] = False,
    json: JsonOption = None,
) -> None:
    """Stream a sequence or a pair from disk and write its disparity.

    Files are 16-bit PNG in KITTI's convention (x256, 0 = none): 0000.png, 0001.png, ... of a
    sequence, disp.png of a pair.
    """
    asyncio.run(
        run(
            source,
            server=server,
            out=out,
            rate=rate,
            iterations=iterations,
            pictures=pictures,
            json=json,
            console=Console(),
        )
    )


@app.command("batch")
def _batch(
    paths: Annotated[
        list[Path], typer.Argument(help="Archives, or folders in any layout that is read.")
    ],
    server: Annotated[
        str | None, typer.Option(help="http://HOST:PORT of a running server; else one is started.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Results go to OUT/NAME.")] = Path("vergence-batch"),
    form: Annotated[
        ResultFormat, typer.Option("--format", help="Of the results; mp4 is for looking at.")
    ] = ResultFormat.PNG16,
    output: Annotated[
        list[Output], typer.Option(help="Of every frame; may be given more than once.")
    ] = [Output.DISPARITY],  # noqa: B006  typer copies it
    iterations: Annotated[
        int, typer.Option(min=0, help="Refinements a frame; 0: the server's default.")
    ] = 0,
    metrics: Annotated[
        bool, typer.Option("--metrics", help="Compare with the truth, where it is there.")
    ] = False,
    json: JsonOption = None,
) -> None:
    """Upload sequences, let the server work through them, and collect the results."""
    asyncio.run(
        batch(
            paths,
            server=server,
            out=out,
            form=form,
            query={
                "output": [each.value for each in output],
                "iterations": iterations,
                "metrics": metrics,
            },
            json=json,
            console=Console(),
        )
    )


@app.command("doctor")
def _doctor(
    server: Annotated[
        str,
        typer.Option(help="HOST:PORT or zenoh://HOST:PORT to look for.", callback=_checked_server),
    ] = DEFAULT_SERVER,
) -> None:
    """Tell what is installed, what is missing, and whether a server answers."""
    if not asyncio.run(doctor(server, Console())):
        raise typer.Exit(1)


def _forwarding_to(entry: metadata.EntryPoint) -> Callable[[typer.Context], None]:
    def forward(context: typer.Context) -> None:
        try:
            command = entry.load()
        except ModuleNotFoundError as error:
            raise CliError(
                f"vergence {entry.name} needs {error.name}, which is not installed; "
                "install it with: pip install 'vergence[server]'"
            ) from None
        contributed = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
        contributed.command()(command)
        contributed(args=context.args, prog_name=f"vergence {entry.name}")

    return forward


for _entry in metadata.entry_points(group=_CONTRIBUTED):
    app.command(
        _entry.name,
        help=_ABOUT.get(_entry.name, f"From {_entry.module}."),
        add_help_option=False,  # its own help knows its options
        context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
    )(_forwarding_to(_entry))
