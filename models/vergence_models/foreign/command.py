"""The command ``vergence models``: add, list and check stereo networks of others.

What it needs is imported when it runs: ``vergence --help`` lists it without onnx.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NoReturn

import typer

from vergence_proto.extras import how_to_install

if TYPE_CHECKING:
    from vergence_models.foreign.adding import Added

models: typer.Typer = typer.Typer(
    help="Serve stereo networks of others: any ONNX graph, added by its contract.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
)

WeightsOption = Annotated[
    Path | None,
    typer.Option(help="Folder of the models; default: the user's own, where serve looks too."),
]


@models.command("add")
def _add(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE.onnx",
            help="The graph; or the same network with several numbers of iterations.",
        ),
    ],
    name: Annotated[str | None, typer.Option(help="Name to serve it by; default: --like.")] = None,
    weights: WeightsOption = None,
    like: Annotated[
        str | None, typer.Option(help="A published contract; vergence models contracts lists them.")
    ] = None,
    left: Annotated[str | None, typer.Option(help="Input of the left image.")] = None,
    right: Annotated[str | None, typer.Option(help="Input of the right image.")] = None,
    pixels: Annotated[
        str | None, typer.Option(help="0..255, 0..1, -1..1 or imagenet: what its inputs expect.")
    ] = None,
    order: Annotated[str | None, typer.Option(help="rgb, bgr or grey.")] = None,
    output: Annotated[str | None, typer.Option(help="Output with the disparity.")] = None,
    factor: Annotated[
        float | None,
        typer.Option(help="Disparity in pixels for each unit of the output; -1: flow."),
    ] = None,
    max_disparity: Annotated[
        int | None, typer.Option(min=16, help="Largest disparity that it finds, in pixels.")
    ] = None,
    multiple_of: Annotated[
        int | None, typer.Option(min=1, help="Its sizes are multiples of this; default: 32.")
    ] = None,
    sigma: Annotated[
        str | None,
        typer.Option(help="constant, confidence, or left-right: a second run on mirrored images."),
    ] = None,
    sigma_px: Annotated[
        float | None, typer.Option(min=0, help="The constant, in pixels; default: 1.")
    ] = None,
    iterations: Annotated[
        list[int] | None,
        typer.Option(
            min=1, help="Number of iterations of each graph; default: iterN in its name, or 1."
        ),
    ] = None,
    warm_start: Annotated[
        bool | None,
        typer.Option(
            "--warm-start/--no-warm-start",
            help="Feed the last disparity, moved to the new pose, to an input such as flow_init; "
            "default: if there is one.",
        ),
    ] = None,
    unproven: Annotated[
        bool, typer.Option("--unproven", help="Write it as guessed: its weights are not trained.")
    ] = False,
) -> None:
    """Add a stereo network, so that vergence serve --model NAME serves it.

    Its contract is guessed from names and shapes, and proven on shifted textures before anything
    is written. A contract that contradicts the textures is refused with what was seen. Red and
    blue look the same on textures: say --order bgr if it wants that.
    """
    with _in_one_line():
        from vergence_models.foreign.adding import add_model
        from vergence_models.foreign.contract import PIXELS, ContractError
        from vergence_models.foreign.files import note_memory
        from vergence_models.foreign.guess import Given, iterations_in
        from vergence_models.foreign.memory import measured_memory

        counts = iterations or [iterations_in(path.stem) for path in files]
        if len(counts) != len(files) or len({*counts}) != len(counts):
            raise ContractError("expected a different --iterations for each file")
        for what, value, allowed in (
            ("--pixels", pixels, PIXELS),
            ("--order", order, ("rgb", "bgr", "grey")),
            ("--sigma", sigma, ("constant", "confidence", "left-right")),
        ):
            if value is not None and value not in allowed:
                raise ContractError(f"{what} is {', '.join(allowed)}, not {value}")
        given = Given(
            like=like,
            left=left,
            right=right,
            pixels=pixels,
            order=_order(order),
            output=output,
            factor=factor,
            max_disparity_px=max_disparity,
            multiple_of=multiple_of,
            sigma=_sigma(sigma),
            sigma_px=sigma_px,
            warm_start=warm_start,
        )
        folder = _folder(weights)
        added = add_model(
            dict(zip(counts, files, strict=True)),
            folder,
            name=name or like or files[0].stem.lower(),
            given=given,
            unproven=unproven,
        )
        if memory := measured_memory(folder, added.name, added.contract):
            note_memory(folder, added.name, memory)
        _show(added)
        at = f" --weights {folder}" if weights else ""
        typer.echo(f"added to {folder}; serve it: vergence serve --model {added.name}{at}")


@models.command("list")
def _list(weights: WeightsOption = None) -> None:
    """List the models of a folder; without --weights, of all that can be served."""
    with _in_one_line():
        from rich.console import Console
        from rich.table import Table

        from vergence_models.foreign.files import read_manifest
        from vergence_proto.model_io import CLASSICAL_MODELS

        folder = _folder(weights)
        entries = sorted(read_manifest(folder)["models"].items())
        table = Table("model", "contract", "iterations", "size", "memory", "proven")
        if weights is None:
            # Where the server looks first: the weights in the package.
            own = read_manifest(Path(__file__).parents[1] / "weights")["models"]
            entries = sorted(own.items()) + entries
        for name, entry in entries:
            about = entry.get("foreign", {})
            size = about.get("contract", {}).get("size")
            stride = f"multiples of {entry['stride']}"
            table.add_row(
                name,
                (about.get("like") or "guessed") if about else "exported",
                ", ".join(entry["graphs"]),
                f"{size[1]}x{size[0]}" if size else stride,
                "yes" if entry["state"] else "none",
                "yes" if about.get("proven", True) else "no",
            )
        if weights is None:
            for name, remembers in CLASSICAL_MODELS.items():
                memory = "yes" if remembers else "none"
                table.add_row(name, "classical", "", "any", memory, "yes")
        console = Console()
        console.print(f"models in {folder}", soft_wrap=True, highlight=False)
        console.print(table)


@models.command("check")
def _check(
    name: Annotated[str, typer.Argument(help="A model that was added.")],
    weights: WeightsOption = None,
) -> None:
    """Prove an added model on shifted textures: sign, sides, scale, pixels and range."""
    with _in_one_line():
        from vergence_models.foreign.adding import check_model

        _show(check_model(_folder(weights), name))


@models.command("contracts")
def _contracts() -> None:
    """List the published contracts, with their licence and source."""
    with _in_one_line():
        from rich.console import Console
        from rich.table import Table

        from vergence_models.foreign.published import PUBLISHED

        table = Table("--like", "pixels", "factor", "licence", "read in", "note")
        for name, each in PUBLISHED.items():
            row = (name, each.pixels, f"{each.factor:g}", each.licence, each.source, each.note)
            table.add_row(*row)
        Console().print(table)


def _show(added: Added) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    like = f"like {added.like}" if added.like else "guessed"
    table = Table(title=f"{added.name}: {like}", title_justify="left", show_header=False)
    for what, value in added.contract.words():
        table.add_row(what, value)
    console.print(table)
    for each in added.changed:
        console.print(f"corrected: {each}", soft_wrap=True, highlight=False)
    if added.proof is None:
        line = "not proven: its weights are taken as not trained"
    else:
        line = (
            f"proven on textures: {100 * added.proof.seen.share:.0f} % of the pixels are right; "
            "not proven: the order of red and blue"
        )
        if added.proof.as_good and not added.pixels_known:
            others = " or ".join(added.proof.as_good)
            line += f"; textures alone do not rule out pixels {others}: say --pixels if you know"
    console.print(line, soft_wrap=True, highlight=False)


def _folder(weights: Path | None) -> Path:
    from vergence_proto.model_io import user_models_dir

    return weights or user_models_dir()


def _order(text: str | None) -> Literal["rgb", "bgr", "grey"] | None:
    return text if text in ("rgb", "bgr", "grey") else None  # type: ignore[return-value]


def _sigma(text: str | None) -> Literal["constant", "left-right", "confidence"] | None:
    return text if text in ("constant", "left-right", "confidence") else None  # type: ignore[return-value]


@contextmanager
def _in_one_line() -> Iterator[None]:
    """Show what the user can mend in one line, with exit code 1."""
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("vergence"):
            raise
        _fail(f"needs {error.name}, which is not installed; install it: {how_to_install('models')}")
    except ValueError as error:
        from vergence_models.foreign.contract import ContractError
        from vergence_proto.model_io import ManifestError

        if not isinstance(error, ContractError | ManifestError):
            raise
        _fail(str(error))
    except OSError as error:
        _fail(str(error))


def _fail(why: str) -> NoReturn:
    typer.echo(f"vergence models: {why}", err=True)
    raise typer.Exit(1)
