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

_HELP = {"help_option_names": ["-h", "--help"]}

app: typer.Typer = typer.Typer(
    help="Live stereo depth over the network.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings=_HELP,
)

# Commands of other installed packages are loaded when they are called: the imports of a server
# would slow every command down, or break it if they are missing.
_CONTRIBUTED = "vergence.commands"
_ABOUT = {"serve": "Serve depth over gRPC, with health and metrics over HTTP."}


JsonOption = Annotated[
    Path | None, typer.Option("--json", help="Write the figures of the table to this file.")
]


def run_program() -> None:
    """Run the command line; an error is one line on stderr and the exit code."""
    try:
        app()
    except (CliError, DepthError, OSError) as error:  # OSError: a file cannot be written
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
    frames: Annotated[int | None, typer.Option(min=1, help="Stop after so many frames.")] = None,
    source: Annotated[
        str | None, typer.Option(help="KIND:PATH of other data than the sample.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the pictures.")] = Path("vergence-demo"),
    json: JsonOption = None,
) -> None:
    """Start a server, stream a sample through it, and draw the result."""
    text = source or bundled_sample()
    asyncio.run(demo(text, frames=frames, out=out, json=json, console=Console()))


@app.command("run")
def _run(
    source: Annotated[str, typer.Argument(help="KIND:PATH, as vergence:DIR or kitti:DIR.")],
    server: Annotated[
        str | None,
        typer.Option(
            help="HOST:PORT or zenoh://HOST:PORT of a running server; default: start one.",
            callback=_checked_server,
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for disparity (default: vergence-run/NAME).")
    ] = None,
    rate: Annotated[
        str,
        typer.Option(help="max: every frame, losslessly. HZ or source: live, newest frames win."),
    ] = "max",
    iterations: Annotated[
        int, typer.Option(min=0, help="Refinement iterations per frame; 0: the server's default.")
    ] = 0,
    pictures: Annotated[
        bool, typer.Option("--pictures", help="Write a picture of some frames.")
    ] = False,
    json: JsonOption = None,
) -> None:
    """Stream a sequence or a pair from disk and write its disparity.

    The files are 16-bit PNG in KITTI's convention (x256, 0 = no value): 0000.png, 0001.png, ...
    for a sequence, disp.png for a pair.
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
        list[Path], typer.Argument(help="Archives, or folders in a supported layout.")
    ],
    server: Annotated[
        str | None, typer.Option(help="http://HOST:PORT of a running server; default: start one.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for results: OUT/NAME.")] = Path(
        "vergence-batch"
    ),
    form: Annotated[
        ResultFormat, typer.Option("--format", help="File format of results; mp4 is for viewing.")
    ] = ResultFormat.PNG16,
    output: Annotated[
        list[Output], typer.Option(help="Map to write for every frame; may be repeated.")
    ] = [Output.DISPARITY],  # noqa: B006  typer copies it
    iterations: Annotated[
        int, typer.Option(min=0, help="Refinement iterations per frame; 0: the server's default.")
    ] = 0,
    metrics: Annotated[
        bool, typer.Option("--metrics", help="Compare with the ground truth, if there is any.")
    ] = False,
    json: JsonOption = None,
) -> None:
    """Upload sequences, wait for the server to process them, and download the results."""
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
        typer.Option(
            help="HOST:PORT or zenoh://HOST:PORT of the server to test.", callback=_checked_server
        ),
    ] = DEFAULT_SERVER,
) -> None:
    """Report what is installed, what is missing, and whether a server answers."""
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
        contributed = typer.Typer(
            add_completion=False, pretty_exceptions_enable=False, context_settings=_HELP
        )
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
