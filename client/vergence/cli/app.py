"""The commands of ``vergence`` and their options.

A command imports what it needs when it is called, so that ``--help`` answers at once.
"""

import math
from collections.abc import Coroutine
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from vergence.cli.errors import CliError
from vergence.cli.options import (
    BaselineOption,
    CalibOption,
    FocalLengthOption,
    JsonOption,
    RateOption,
    ServerOption,
    checked_server,
)
from vergence.transports.addresses import DEFAULT_SERVER
from vergence.transports.credentials import use_files
from vergence_proto.errors import DepthError
from vergence_proto.jobs import (
    MAP_FORMATS,
    JobOutput,
    JobPriority,
    OnError,
    Output,
    Quality,
    ResultFormat,
)

if TYPE_CHECKING:
    from rich.console import Console

Value = TypeVar("Value")

app: typer.Typer = typer.Typer(
    help="Live stereo depth over the network.",
    no_args_is_help=True,
    rich_markup_mode="markdown",  # it joins the lines of a paragraph
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _await(work: Coroutine[Any, Any, Value]) -> Value:
    from vergence.cli.ending import run_until_stopped

    return run_until_stopped(work)


def _console() -> "Console":
    from rich.console import Console

    return Console()


def run_program() -> None:
    """Run the command line; an error is one line on stderr and the exit code."""
    try:
        app(prog_name="vergence")
    except (CliError, DepthError, OSError) as error:  # OSError: a file cannot be written
        from rich.console import Console

        Console(stderr=True, soft_wrap=True, highlight=False).print(
            f"vergence: {error}", style="red", markup=False
        )
        raise SystemExit(getattr(error, "exit_code", 1)) from None


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"vergence {metadata.version('vergence')}")
        raise typer.Exit


@app.callback()
def _vergence(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Show it.")
    ] = False,
    token_file: Annotated[
        Path | None,
        typer.Option(
            help="File with the token for the server; also VERGENCE_TOKEN_FILE, or VERGENCE_TOKEN "
            "with the token itself.",
            exists=True,
            dir_okay=False,
        ),
    ] = None,
    ca: Annotated[
        Path | None,
        typer.Option(
            help="PEM file of the authority that signed the server's certificate; also "
            "VERGENCE_CA.",
            exists=True,
            dir_okay=False,
        ),
    ] = None,
) -> None:
    use_files(token_file=token_file, ca=ca)


@app.command("demo")
def _demo(
    frames: Annotated[int | None, typer.Option(min=1, help="Stop after so many frames.")] = None,
    source: Annotated[
        str | None, typer.Option(help="KIND:PATH of other data than the sample.")
    ] = None,
    server: ServerOption = None,
    out: Annotated[Path, typer.Option(help="Folder for the pictures.")] = Path("vergence-demo"),
    json: JsonOption = None,
) -> None:
    """Start a server, or use a running one; stream a sample through it, and draw the result."""
    from vergence.cli.demo import bundled_sample, demo

    text = source or bundled_sample()
    _await(demo(text, server=server, frames=frames, out=out, json=json, console=_console()))


@app.command(
    "run",
    epilog="""
```
vergence run recording/                          # a data set in any known layout
vergence run left.png right.png --fx 640 --baseline 0.12
vergence run camera:0 --calib rig.json           # both views side by side, until Ctrl-C
vergence run kitti:DIR/sequences/00 --rate 10    # live at 10 Hz: the newest frame wins
```
""",
)
def _run(
    source: Annotated[
        list[str],
        typer.Argument(
            metavar="SOURCE | LEFT RIGHT",
            help="A folder in the layout of a data set, KIND:PATH, two images, a side-by-side "
            "video, or camera:0.",
        ),
    ],
    calib: CalibOption = None,
    fx: FocalLengthOption = None,
    baseline: BaselineOption = None,
    server: ServerOption = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for disparity (default: vergence-run/NAME).")
    ] = None,
    rate: RateOption = "max",
    frames: Annotated[int | None, typer.Option(min=1, help="Stop after so many frames.")] = None,
    iterations: Annotated[
        int, typer.Option(min=0, help="Refinement iterations per frame; 0: the server's default.")
    ] = 0,
    output: Annotated[
        list[Output] | None,
        typer.Option(help="Map to write for every frame; may be repeated. Default: disparity."),
    ] = None,
    form: Annotated[
        ResultFormat, typer.Option("--format", help="File format: png16, pfm or npz.")
    ] = ResultFormat.PNG16,
    min_confidence: Annotated[
        int, typer.Option(min=0, max=255, help="Leave out less certain values.")
    ] = 0,
    min_depth: Annotated[
        float, typer.Option(min=0, help="Leave out what is nearer, in metres.")
    ] = 0.0,
    max_depth: Annotated[
        float, typer.Option(min=0, help="Leave out what is farther, in metres.")
    ] = math.inf,
    speckle: Annotated[
        int, typer.Option(min=0, help="Leave out regions of up to so many pixels.")
    ] = 0,
    pictures: Annotated[
        bool | None,
        typer.Option(
            "--pictures/--no-pictures",
            help="Draw some frames; by default those of images and cameras.",
        ),
    ] = None,
    json: JsonOption = None,
) -> None:
    """Stream files or a camera and write disparity.

    The files are 16-bit PNG in KITTI's convention (x256, 0 = no value): 0000.png, 0001.png, ...
    for a sequence, disp.png for a pair. Images and cameras with --calib, or --fx and --baseline,
    give depth too: depth/0000.png or depth.png, metres x256. rig.json is the rectified rig. The
    results of an earlier run in the same folder are replaced.
    """
    from vergence.cli.result_folder import Files, KeptValues
    from vergence.cli.run import run
    from vergence.cli.sources import CalibrationFlags

    if form not in MAP_FORMATS:
        raise CliError(f"--format {form} is for vergence batch; run writes png16, pfm or npz")
    kept = KeptValues(min_confidence, min_depth, max_depth, speckle)
    _await(
        run(
            source,
            CalibrationFlags(calib, fx, baseline),
            server=server,
            out=out,
            rate=rate,
            frames=frames,
            iterations=iterations,
            files=Files(output or (), form, kept),
            pictures=pictures,
            json=json,
            console=_console(),
        )
    )


@app.command(
    "record",
    epilog="""
```
vergence record camera:0 walk.mcap --calib rig.json    # until Ctrl-C; Foxglove shows the file
vergence run walk.mcap                                 # the same results again
```
""",
)
def _record(
    source: Annotated[
        str,
        typer.Argument(help="A folder in the layout of a data set, KIND:PATH, video or camera:0."),
    ],
    file: Annotated[Path, typer.Argument(metavar="FILE.mcap", help="The file to write.")],
    calib: CalibOption = None,
    fx: FocalLengthOption = None,
    baseline: BaselineOption = None,
    server: ServerOption = None,
    rate: RateOption = "max",
    frames: Annotated[int | None, typer.Option(min=1, help="Stop after so many frames.")] = None,
) -> None:
    """Stream files or a camera, and record images, poses, calibration and depth as one MCAP file.

    A viewer such as Foxglove plays the file, and `vergence run FILE.mcap` repeats the session.
    """
    from vergence.cli.record import record
    from vergence.cli.sources import CalibrationFlags

    _await(
        record(
            [source],
            file,
            CalibrationFlags(calib, fx, baseline),
            server=server,
            rate=rate,
            frames=frames,
            console=_console(),
        )
    )


@app.command("batch")
def _batch(
    paths: Annotated[
        list[Path] | None, typer.Argument(help="Archives, or folders in a supported layout.")
    ] = None,
    server: Annotated[
        str | None, typer.Option(help="http://HOST:PORT of a running server; default: start one.")
    ] = None,
    rerun: Annotated[
        list[str] | None,
        typer.Option(help="Id of a job of the server that has kept its input; may be repeated."),
    ] = None,
    ray: Annotated[
        str | None,
        typer.Option(help="A Ray cluster that does the work: its address, or local."),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for results: OUT/NAME.")] = Path(
        "vergence-batch"
    ),
    form: Annotated[
        ResultFormat, typer.Option("--format", help="File format of results; mp4 is for viewing.")
    ] = ResultFormat.PNG16,
    output: Annotated[
        list[JobOutput], typer.Option(help="What to write for every frame; may be repeated.")
    ] = [JobOutput.DISPARITY],  # noqa: B006  typer copies it
    on_error: Annotated[
        OnError, typer.Option(help="What a frame does that cannot be read or stepped.")
    ] = OnError.SKIP,
    iterations: Annotated[
        int, typer.Option(min=0, help="Iterations of a single pair; 0: the server's default.")
    ] = 0,
    quality: Annotated[
        Quality, typer.Option(help="steady: less flicker, 2 x the time; best: fewer errors, 6 x.")
    ] = Quality.FAST,
    metrics: Annotated[
        bool, typer.Option("--metrics", help="Compare with the ground truth, if there is any.")
    ] = False,
    priority: Annotated[
        JobPriority, typer.Option(help="Which of the waiting jobs of the server is next.")
    ] = JobPriority.NORMAL,
    keep_input: Annotated[
        bool, typer.Option("--keep-input", help="Keep job and input on the server, for --rerun.")
    ] = False,
    json: JsonOption = None,
) -> None:
    """Upload sequences, wait for the server to process them, and download the results."""
    if ray is not None and server is not None:
        raise typer.BadParameter("--ray starts servers of its own; leave --server out")
    if (rerun or keep_input) and server is None:
        raise typer.BadParameter("--rerun and --keep-input need the --server that keeps the jobs")
    if not paths and not rerun:
        raise typer.BadParameter("name at least one archive or folder, or a job with --rerun")
    from vergence.cli.batch import batch

    _await(
        batch(
            paths or [],
            server=server,
            out=out,
            form=form,
            query={
                "output": [each.value for each in output],
                "iterations": iterations,
                "quality": quality.value,
                "metrics": metrics,
                "on_error": on_error.value,
                "priority": priority.value,
                "keep_input": keep_input,
            },
            again=rerun or [],
            json=json,
            console=_console(),
            ray=ray,
        )
    )


@app.command("calib")
def _calib(
    file: Annotated[Path, typer.Argument(help="The file, the left camera's, or a folder.")],
    right: Annotated[
        Path | None, typer.Argument(help="The right camera's file, or OpenCV's extrinsics.")
    ] = None,
    size: Annotated[
        str | None, typer.Option(help="WIDTHxHEIGHT, if the file does not state it.")
    ] = None,
    unit_m: Annotated[
        float, typer.Option(min=0, help="Metres in a unit of length of OpenCV's file.")
    ] = 1.0,
    out: Annotated[
        Path | None, typer.Option(help="Write the rig to this file, in our own format.")
    ] = None,
) -> None:
    """Read a stereo calibration of any known tool, and show the rig.

    Kalibr, Basalt, Monado, OpenCV, a pair of ROS CameraInfo, a pair of EuRoC's sensor.yaml.
    """
    from vergence.cli.calib import calib

    calib(file, right, size=size, unit_m=unit_m, out=out, console=_console())


@app.command("doctor")
def _doctor(
    source: Annotated[
        str | None,
        typer.Argument(help="KIND:PATH of a recording to examine, in place of this machine."),
    ] = None,
    *,
    server: Annotated[
        str | None,
        typer.Option(
            help="HOST:PORT, http://HOST:PORT or zenoh://HOST:PORT of the server to test.",
            callback=checked_server,
        ),
    ] = None,
    seconds: Annotated[
        float, typer.Option(min=1, help="With --server: the length of the test stream.")
    ] = 5.0,
) -> None:
    """Report what is installed, what is missing, and whether a server answers.

    With `--server`: stream a sample there as a headset would, measure times and rates, and say what
    to expect.

    With a recording: find swapped eyes, rows or times that do not fit, a wrong baseline or focal
    length, and poses of other axes, inverted, or of another time.
    """
    if source is not None:
        from vergence.cli.doctor import examine

        if not examine(source, _console()):
            raise typer.Exit(1)
        return
    from vergence.cli.doctor import doctor, examine_link

    console = _console()
    if not _await(doctor(server or DEFAULT_SERVER, console)):
        raise typer.Exit(1)
    if server is not None:
        _await(examine_link(server, seconds, console))


@app.command("top")
def _top(
    server: Annotated[
        str, typer.Option(help="http[s]://HOST:PORT of the administrator's port.")
    ] = "http://127.0.0.1:8001",
    every: Annotated[float, typer.Option(min=0.1, help="Seconds between two looks.")] = 1.0,
    once: Annotated[bool, typer.Option("--once", help="Print the table once.")] = False,
) -> None:
    """Show the open streams of a server: rate, age, origin, drops, time in the model."""
    from vergence.cli.top import top

    _await(top(server, _console(), every_s=every, once=once))


def _add_contributed(entry: metadata.EntryPoint) -> None:
    """Add the command of another package; if it cannot be loaded, the command says why."""
    try:
        command = entry.load()
    except ModuleNotFoundError as error:
        missing = error.name

        def report() -> None:
            raise CliError(f"vergence {entry.name} needs {missing}, which is not installed")

        command = report
    if isinstance(command, typer.Typer):
        app.add_typer(command, name=entry.name)
    else:
        app.command(entry.name)(command)


# Commands of the server and of the models. Their modules import what they need when called.
for _entry in metadata.entry_points(group="vergence.commands"):
    _add_contributed(_entry)
