"""`python -m vergence_models.data.xrbench`: render sets of recipes, or one of your own."""

from __future__ import annotations

import dataclasses
import shlex
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TimeRemainingColumn
from rich.table import Table

from vergence_models.data.xrbench.recipe import KINDS, SETS, BadRecipe, Recipe
from vergence_models.data.xrbench.tracer import VARIANTS, NoRenderer
from vergence_models.data.xrbench.writer import PASSES, render_sequence

_DEFAULTS = Recipe(KINDS[0])


def main(
    out: Annotated[
        Path | None, typer.Option(help="Folder of the data set; made if missing.")
    ] = None,
    set_: Annotated[str | None, typer.Option("--set", help=f"One of {', '.join(SETS)}.")] = None,
    recipe: Annotated[
        list[Path] | None, typer.Option(help="A recipe's JSON, as recipes/ of a set holds them.")
    ] = None,
    room: Annotated[str | None, typer.Option(help=f"One of {', '.join(KINDS)}.")] = None,
    seed: int = _DEFAULTS.seed,
    frames: int | None = None,
    size: Annotated[str | None, typer.Option(metavar="WxH", help="640x480 if not given.")] = None,
    speed: Annotated[float, typer.Option(help="Of the head; 1 is calm, 20 violent.")] = 1.0,
    fps: float = _DEFAULTS.fps,
    fov: Annotated[float, typer.Option(help="Degrees across the width.")] = _DEFAULTS.fov_deg,
    baseline: Annotated[float, typer.Option(help="Metres.")] = _DEFAULTS.baseline_m,
    samples: Annotated[int | None, typer.Option(help="Light paths a pixel.")] = None,
    passes: Annotated[str, typer.Option(help="Which images: clean, final or both.")] = "both",
    variant: Annotated[
        str | None, typer.Option(help=f"Of Mitsuba: {', '.join(VARIANTS)}; LLVM's if not given.")
    ] = None,
    list_: Annotated[
        bool, typer.Option("--list", help="Tell what the sets hold, and stop.")
    ] = False,
) -> None:
    """Path-trace stereo sequences of indoor scenes with every ground truth.

    `--set benchmark --out DIR` renders the whole benchmark; a stopped run goes on where it was.
    `vergence run sceneflow:DIR/frames_finalpass/NAME` reads a sequence.
    """
    console = Console()
    if list_:
        console.print(_table())
        return
    try:
        recipes = _chosen(set_, recipe or [], room, seed, speed, fps, fov, baseline)
        recipes = [_adapted(each, frames, size, samples) for each in recipes]
        chosen = PASSES if passes == "both" else (passes,)
        if out is None or not set(chosen) <= set(PASSES):
            raise BadRecipe("--out DIR is needed" if out is None else f"no pass {passes!r}")
        _render(recipes, out, chosen, variant, console)
    except (BadRecipe, NoRenderer) as error:
        raise SystemExit(f"error: {error}") from None
    except KeyboardInterrupt:
        raise SystemExit("stopped; the same command goes on from here") from None


def _chosen(
    set_: str | None, files: list[Path], room: str | None, seed: int, speed: float, fps: float,
    fov: float, baseline: float,
) -> list[Recipe]:  # fmt: skip
    if (set_ is not None) + bool(files) + (room is not None) != 1:
        raise BadRecipe("give one of --set, --recipe and --room (or --list)")
    if set_ is not None:
        if set_ not in SETS:
            raise BadRecipe(f"no set {set_!r}; there are {', '.join(SETS)}")
        return list(SETS[set_])
    if room is not None:
        return [Recipe(room, seed=seed, speed=speed, fps=fps, fov_deg=fov, baseline_m=baseline)]
    try:
        return [Recipe.from_json(path.read_text("utf-8"), path) for path in files]
    except OSError as error:
        raise BadRecipe(str(error)) from None


def _adapted(recipe: Recipe, frames: int | None, size: str | None, samples: int | None) -> Recipe:
    if frames is not None:
        recipe = dataclasses.replace(recipe, frames=frames)
    if samples is not None:
        recipe = dataclasses.replace(recipe, samples=samples)
    if size is None:
        return recipe
    width, _, height = size.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise BadRecipe(f"--size takes WxH, such as 640x480, got {size!r}")
    return dataclasses.replace(recipe, width=int(width), height=int(height))


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
    typer.run(main)
