"""``vergence doctor``: report what is installed, what is missing, and how to install it."""

import asyncio
import importlib.util
import platform
import socket
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import Enum
from http.client import HTTPConnection, HTTPException
from importlib import metadata
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from vergence.cli.errors import CliError
from vergence.cli.link_check import CAMERA_HZ, link_advice, measure_link
from vergence.cli.sources import source_at
from vergence.client import DepthClient
from vergence_proto.datasets import DatasetError
from vergence_proto.errors import DepthError
from vergence_proto.extras import Extra, how_to_install
from vergence_proto.instruction_set import UNKNOWN, instruction_set
from vergence_proto.model_io import ManifestError, load_model_card

# The packages of each extra, and of the base install.
_PACKAGES: dict[Extra | None, tuple[str, ...]] = {
    None: ("grpcio", "numpy", "opencv-python-headless", "protobuf"),
    "cli": ("av", "httpx", "rich", "typer"),
    "server": ("fastapi", "grpcio-health-checking", "onnxruntime", "prometheus-client", "uvicorn"),
    "zenoh": ("eclipse-zenoh",),
    "train": ("torch", "onnx", "onnxscript"),
}
_DEFAULT_MODEL = "lite"
_PORTS = {50051: "gRPC", 8000: "HTTP"}


class Verdict(Enum):
    """The mark in front of a finding."""

    GOOD = "[green]ok[/]"
    NOTE = "[yellow]--[/]"  # missing, but not needed by everybody
    BAD = "[red]no[/]"


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the report."""

    verdict: Verdict
    what: str
    detail: str


async def doctor(server: str, console: Console) -> bool:
    """Print all findings; return False if a requirement of every command is not met."""
    reached = await _reachable(server)
    answers = server if reached.verdict is Verdict.GOOD else ""
    ports = await asyncio.to_thread(lambda: [*_ports(answers)])  # one of them may be asked
    findings = [_python(), _cpu(), *_packages(), *ports, _weights(), _native(), reached]
    table = Table(show_header=False, box=None)
    for finding in findings:
        # As text: the brackets of an extra are not markup.
        table.add_row(finding.verdict.value, Text(finding.what), Text(finding.detail))
    console.print(table)
    return all(finding.verdict is not Verdict.BAD for finding in findings)


async def examine_link(server: str, seconds: float, console: Console) -> None:
    """Print what a test stream to a server measured, and what to expect of the link."""
    figures = await measure_link(server, seconds, console)
    link = figures.link
    trip = "unknown" if figures.round_trip_s is None else f"{1e3 * figures.round_trip_s:.1f} ms"
    ages = " / ".join(f"{1e3 * figures.age_s(each):.0f}" for each in (50, 95, 100))
    images = f"JPEG {link.jpeg_quality}, " + ("half size" if link.scale == 2 else "full size")
    rows = {
        "session opens in": f"{1e3 * figures.open_s:.0f} ms",
        "round trip": trip,
        "results": f"{figures.results_hz:.1f} per second of {CAMERA_HZ:.0f} filmed",
        "age": f"{ages} ms (median / 95 % / oldest)",
        "longest silence": f"{figures.longest_silence_s:.2f} s",
        "limited by": link.limited_by,
        "chosen": f"{images}; maps of every {link.map_step}. pixel" if link.adapts else "exact",
    }
    table = Table(show_header=False, box=None)
    for name, value in rows.items():
        table.add_row(name, Text(value))
    console.print(table)
    for sentence in link_advice(figures):
        console.print(Text(sentence), soft_wrap=True)


def examine(text: str, console: Console) -> bool:
    """Print what is wrong with a recording ``KIND:PATH``; return whether nothing is.

    Raises CliError: it does not exist, or is damaged.
    """
    from vergence.source_check import check_source

    source = source_at(text).without_truth()
    missing = source.missing_images
    if missing:
        kept = [each for each in source.files if not {each.left, each.right} & {*missing}]
        source = replace(source, files=kept)
    for each in (*source.notes, *(f"{path}: not found" for path in missing)):
        console.print(Text(each), style="yellow", soft_wrap=True)
    has_poses = all(each.world_from_left is not None for each in source.files)
    with console.status(f"matching the images of {source.name}"):
        try:
            found = check_source(source)
        except DatasetError as error:
            raise CliError(str(error), exit_code=2) from None
    for advice in found:
        console.print(Text(f"{advice.mistake}: {advice.sentence}"), style="yellow")
    if not found:
        looked_at = "images, poses and calibration" if has_poses else "images and calibration"
        wrong = "nothing else wrong" if missing or source.notes else "nothing wrong"
        console.print(f"{source.name}: {wrong}; {looked_at} fit each other")
    if not has_poses:
        console.print("Not every frame has a pose, so motion was not examined.")
    return not (found or missing)


def _python() -> Finding:
    found = platform.python_version()
    verdict = Verdict.GOOD if sys.version_info >= (3, 11) else Verdict.BAD
    return Finding(verdict, "python", f"{found} (3.11 or newer is needed)")


def _cpu() -> Finding:
    found = instruction_set()
    verdict = Verdict.NOTE if found == UNKNOWN else Verdict.GOOD
    return Finding(verdict, "cpu", f"{found} (best instruction set for int8)")


def _packages() -> Iterator[Finding]:
    for extra, names in _PACKAGES.items():
        found, missing = [], []
        for name in names:
            try:
                found.append(f"{name} {metadata.version(name)}")
            except metadata.PackageNotFoundError:
                missing.append(name)
        package = f"vergence[{extra}]" if extra else "vergence"
        if missing:
            verdict = Verdict.NOTE if extra else Verdict.BAD
            advice = f"without {', '.join(missing)}: {how_to_install(extra)}"
            yield Finding(verdict, package, advice)
        else:
            yield Finding(Verdict.GOOD, package, ", ".join(found))


def _ports(answers: str) -> Iterator[Finding]:
    """Check the default ports; ``answers`` is the address at which a server was reached."""
    for port, use in _PORTS.items():
        address = f"127.0.0.1:{port}"
        with socket.socket() as probe:
            if sys.platform != "win32":  # there it would allow a port that is taken
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(("127.0.0.1", port))
            except OSError as error:
                if answers.endswith(f":{port}") or _is_alive(port):
                    yield Finding(Verdict.GOOD, f"{use} port", f"{address}: a Vergence server")
                else:
                    taken = f"{address} is taken by another program ({error.strerror})"
                    yield Finding(Verdict.NOTE, f"{use} port", taken)
            else:
                yield Finding(Verdict.GOOD, f"{use} port", f"{address} is free")


def _is_alive(port: int) -> bool:
    """Ask for the life sign that a server gives over HTTP."""
    connection = HTTPConnection("127.0.0.1", port, timeout=1)
    try:
        connection.request("GET", "/healthz")
        return b"alive" in connection.getresponse().read()
    except (OSError, HTTPException):
        return False
    finally:
        connection.close()


def _weights() -> Finding:
    spec = importlib.util.find_spec("vergence_models")
    if spec is None or spec.origin is None:
        return Finding(Verdict.NOTE, "weights", f"not installed: {how_to_install('server')}")
    directory = Path(spec.origin).parent / "weights"
    try:
        card = load_model_card(directory, _DEFAULT_MODEL)
    except ManifestError as error:
        return Finding(Verdict.BAD, "weights", str(error))
    summary = (
        f"{card.name} {card.weights_sha256[:12]}, matches its manifest; "
        f"searches {card.max_disparity_px} px"
    )
    return Finding(Verdict.GOOD, "weights", summary)


def _native() -> Finding:
    spec = importlib.util.find_spec("vergence_native")
    if spec is None or spec.origin is None:
        return Finding(Verdict.NOTE, "native step", "not installed; onnxruntime serves")
    folder = Path(spec.origin).parent
    if any(folder.joinpath(f"vergence_native{end}").exists() for end in (".so", ".dylib", ".dll")):
        return Finding(Verdict.GOOD, "native step", "built; it serves lite on a CPU")
    advice = "not built, onnxruntime serves; install gcc or clang and install vergence again"
    return Finding(Verdict.NOTE, "native step", advice)


async def _reachable(server: str) -> Finding:
    try:
        async with DepthClient(server) as client:
            info = await client.server_info()
    except DepthError as error:
        return Finding(Verdict.NOTE, "server", str(error))
    model = f"{info.model.name} {info.model.weights_sha256[:12]}"
    streams = f"{info.streams_open} of {info.streams_max} streams"
    place = f"{info.provider} of {info.engine}" if info.engine else info.provider
    if info.instruction_set:
        place += f" ({info.instruction_set})"
    reach = f"searches {info.model.max_disparity_px} px"
    about = f"{server} runs {info.version}, model {model} on {place}, {reach}, {streams}"
    return Finding(Verdict.GOOD, "server", about)
