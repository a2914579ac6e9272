"""`python -m vergence_models.data.xrbench`: render sets of recipes, or one of your own."""

from __future__ import annotations

import dataclasses
import shlex
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TimeRemainingColumn
from rich.table import Table

from vergence_models.data.xrbench.recipe import KINDS, SETS, BadRecipe, Recipe
from vergence_models.data.xrbench.sheet import contact_sheet
from vergence_models.data.xrbench.tracer import VARIANTS, NoRenderer
from vergence_models.data.xrbench.writer import PASSES, encode_png, render_sequence
from vergence_proto.datasets import DatasetError


def _option(field: str, text: str) -> typer.models.OptionInfo:
    """An option that replaces a field of every chosen recipe."""
    option: typer.models.OptionInfo = typer.Option(
        help=f"{text} The recipe's own ({getattr(Recipe(KINDS[0]), field):g}) if not given."
    )
    return option


def main(
    out: Annotated[
        Path | None, typer.Option(help="Folder of the data set; made if missing.")
    ] = None,
    set_: Annotated[str | None, typer.Option("--set", help=f"One of {', '.join(SETS)}.")] = None,
    recipe: Annotated[
        list[Path] | None, typer.Option(help="A recipe's JSON, as recipes/ of a set holds them.")
    ] = None,
    room: Annotated[str | None, typer.Option(help=f"One of {', '.join(KINDS)}.")] = None,
    seed: Annotated[int | None, _option("seed", "Of the room and the head's path.")] = None,
    frames: Annotated[int | None, _option("frames", "Of each sequence.")] = None,
    size: Annotated[str | None, typer.Option(metavar="WxH", help="640x480 if not given.")] = None,
    speed: Annotated[float | None, _option("speed", "Of the head; 20 is violent.")] = None,
    fps: Annotated[float | None, _option("fps", "Frames a second.")] = None,
    fov: Annotated[float | None, _option("fov_deg", "Degrees across the width.")] = None,
    baseline: Annotated[float | None, _option("baseline_m", "Metres.")] = None,
    samples: Annotated[int | None, _option("samples", "Light paths a pixel.")] = None,
    passes: Annotated[str, typer.Option(help="Which images: clean, final or both.")] = "both",
    variant: Annotated[
        str | None, typer.Option(help=f"Of Mitsuba: {', '.join(VARIANTS)}; LLVM's if not given.")
    ] = None,
    sheet: Annotated[
        Path | None, typer.Option(help="A PNG of the last sequence's first frame, all truths.")
    ] = None,
    list_: Annotated[
        bool, typer.Option("--list", help="Print the contents of the sets, and stop.")
    ] = False,
) -> None:
    """Path-trace stereo sequences of indoor scenes with every ground truth.

    `--set benchmark --out DIR` renders the whole benchmark; a stopped run continues.
    `vergence run sceneflow:DIR/frames_finalpass/NAME` reads a sequence.
    """
    console = Console()
    if list_:
        console.print(_table())
        return
    try:
        width, height = _parsed(size)
        fields = {
            "seed": seed, "frames": frames, "width": width, "height": height, "speed": speed,
            "fps": fps, "fov_deg": fov, "baseline_m": baseline, "samples": samples,
        }  # fmt: skip
        given: dict[str, Any] = {name: x for name, x in fields.items() if x is not None}
        recipes = [dataclasses.replace(each, **given) for each in _chosen(set_, recipe or [], room)]
        chosen = PASSES if passes == "both" else (passes,)
        if out is None or not set(chosen) <= set(PASSES):
            raise BadRecipe("--out DIR is needed" if out is None else f"no pass {passes!r}")
        _render(recipes, out, chosen, variant, console)
        if sheet:
            sheet.write_bytes(encode_png(contact_sheet(out, recipes[-1].name, 0)))
    except (BadRecipe, NoRenderer, DatasetError, OSError) as error:
        raise SystemExit(f"error: {error}") from None
    except KeyboardInterrupt:
        raise SystemExit("stopped; the same command continues from here") from None


def _chosen(set_: str | None, files: list[Path], room: str | None) -> list[Recipe]:
    if (set_ is not None) + bool(files) + (room is not None) != 1:
        raise BadRecipe("give one of --set, --recipe and --room (or --list)")
    if room is not None:
        return [Recipe(room)]
    if set_ is None:
        return [Recipe.from_json(path.read_text("utf-8"), path) for path in files]
    if set_ not in SETS:
        raise BadRecipe(f"no set {set_!r}; there are {', '.join(SETS)}")
    return list(SETS[set_])


def _parsed(size: str | None) -> tuple[int | None, int | None]:
    if size is None:
        return None, None
    width, _, height = size.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise BadRecipe(f"--size takes WxH, such as 640x480, got {size!r}")
    return int(width), int(height)


def _render(
    recipes: list[Recipe], out: Path, passes: tuple[str, ...], variant: str | None, console: Console
) -> None:
    columns = (*Progress.get_default_columns()[:2], MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console) as progress:
        bar = progress.add_task("frames", total=sum(recipe.frames for recipe in recipes))
        for recipe in recipes:
            progress.update(bar, description=recipe.name)
            where = render_sequence(
                recipe, out, passes=passes, variant=variant, on_frame=lambda: progress.advance(bar)
            )
            progress.console.print(f"vergence run {shlex.quote(f'sceneflow:{where}')}")


def _table() -> Table:
    table = Table("set", "sequence", "frames", "size", "speed", "baseline", "paths")
    for name, recipes in SETS.items():
        for each in recipes:
            size = f"{each.width}x{each.height}"
            table.add_row(name, each.name, str(each.frames), size, f"{each.speed:g}x",
                          f"{each.baseline_m:g} m", str(each.samples))  # fmt: skip
    return table


if __name__ == "__main__":
    program = typer.Typer(
        add_completion=False, context_settings={"help_option_names": ["-h", "--help"]}
    )
    program.command()(main)
    program()
