r"""``python -m vergence_models.studies --json FILE``: the paper's studies, on our networks.

    python -m vergence_models.studies --json out/studies.json
    python -m vergence_models.studies --json out/studies.json --studies times   # that one again
    python -m vergence_models.studies --json out/studies.json --render
    python -m vergence_models.studies --json out/studies.json --studies --data vergence:DIR
    python -m vergence_models.studies --json FILE --weights DIR DIR --run runs/lite \
        --data sceneflow:BENCH --kitti vergence:DIR

Markdown and PNG plots are written beside FILE. A study is written down as soon as it is done;
those in FILE that are not run again are kept, with the training state they were made with. The
networks are the graphs of ``--weights``, and of ``--run`` (by PyTorch) the iteration counts that
no graph has. The held-out clips are rendered into ``--cache`` once.
"""

from __future__ import annotations

import argparse
import logging
import sys
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TimeElapsedColumn

from vergence_models.config import ConfigError
from vergence_models.evaluate import WEIGHTS
from vergence_models.studies.bench import Bench
from vergence_models.studies.experiments import STUDIES, Study, kitti, on_data
from vergence_models.studies.footage import StudySettings, group_on_disk
from vergence_models.studies.networks import TIERS, gather_networks
from vergence_models.studies.plots import draw_plots
from vergence_models.studies.tables import (
    StudyFileError,
    Table,
    markdown,
    read_tables,
    write_tables,
)
from vergence_models.training.runs import RunError
from vergence_proto.datasets import DatasetError
from vergence_proto.model_io import ManifestError

log = logging.getLogger("vergence_models.studies")
QUICK = StudySettings(clips=2, frames=8, short=4, timed=2)


def parse(arguments: list[str] | None) -> argparse.Namespace:
    usual = StudySettings()
    parser = argparse.ArgumentParser(
        prog="vergence_models.studies",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--json", type=Path, required=True, help="results; Markdown and PNGs go beside it")
    add("--render", action="store_true", help="write Markdown and plots of FILE again, run nothing")
    add("--studies", nargs="*", metavar="NAME", help=f"some of {', '.join(STUDIES)}; default: all")
    add("--weights", type=Path, nargs="+", default=[WEIGHTS], help="folders with a manifest")
    add("--model", nargs="*", default=[], help="models of vergence models add, a row each")
    add("--run", type=Path, nargs="*", default=[], help="training runs, computed by PyTorch")
    add("--data", nargs="*", default=[], help="KIND:PATH, each a table of its own")
    add("--kitti", help="KIND:PATH of KITTI odometry with truth, by the paper's protocol")
    add("--cache", type=Path, default=Path("out/study-clips"), help="folder of rendered clips")
    add("--clips", type=int, default=usual.clips)
    add("--frames", type=int, default=usual.frames, help="most frames of a clip or sequence")
    add("--textures", type=Path, help="folder of photographs for the clips")
    add("--quick", action="store_true", help=f"{QUICK.clips} clips of {QUICK.frames} frames")
    add("--workers", type=int, default=2, help="processes that render")
    add("--threads", type=int, default=2, help="threads of each network")
    given = parser.parse_args(arguments)
    given.studies = list(STUDIES) if given.studies is None else given.studies
    unknown = set(given.studies) - set(STUDIES)
    if unknown:
        parser.error(f"no study {', '.join(sorted(unknown))}; there are {', '.join(STUDIES)}")
    return given


def chosen(given: argparse.Namespace, frames: int) -> dict[str, Study]:
    """Name -> study, sources on disk included."""
    extra: dict[str, Study] = {}
    for spec in given.data:
        name = f"data_{Path(spec.partition(':')[2].partition('?')[0]).name}"
        extra[name] = partial(on_data, group=group_on_disk(spec, frames), name=name)
    if given.kitti:
        extra["kitti"] = partial(kitti, group=group_on_disk(given.kitti, frames))
    return {name: STUDIES[name] for name in STUDIES if name in given.studies} | extra


def report(tables: dict[str, Table], path: Path) -> None:
    """Write all finished studies: JSON, Markdown and plots."""
    order = [*STUDIES, *sorted(set(tables) - set(STUDIES))]
    known = [tables[name] for name in order if name in tables]
    write_tables(path, known)
    drawn = draw_plots(known, path.parent)
    path.with_suffix(".md").write_text(markdown(known, missing_tiers(known), drawn), "utf-8")


def missing_tiers(tables: list[Table]) -> list[str]:
    """The tiers that no row of the studies is about."""
    labels = [label for table in tables if table.name in STUDIES for label in table.labels]
    return [tier for tier in TIERS if labels and not any(row.startswith(tier) for row in labels)]


def main(arguments: list[str] | None = None) -> None:
    given = parse(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    settings = (
        QUICK
        if given.quick
        else StudySettings(
            clips=given.clips,
            frames=given.frames,
            short=min(given.frames, StudySettings().short),
            textures=given.textures,
        )
    )
    given.json.parent.mkdir(parents=True, exist_ok=True)
    columns = (SpinnerColumn(), *Progress.get_default_columns()[:1], TimeElapsedColumn())
    try:
        tables = read_tables(given.json)
        if given.render:
            report(tables, given.json)
            return
        networks = gather_networks(
            given.weights, given.run, threads=given.threads, models=given.model
        )
        with Progress(*columns, console=Console(stderr=True)) as progress:
            bench = Bench(
                networks,
                settings=settings,
                cache=given.cache,
                workers=given.workers,
                progress=progress,
            )
            for name, study in chosen(given, settings.frames).items():
                log.info("study: %s", name)
                tables[name] = study(bench)
                report(tables, given.json)
    except (
        ConfigError,
        FileNotFoundError,
        DatasetError,
        ManifestError,
        RunError,
        StudyFileError,
    ) as error:
        sys.exit(f"vergence_models.studies: {error}")
    sys.stdout.write(given.json.with_suffix(".md").read_text("utf-8"))


if __name__ == "__main__":
    main()
