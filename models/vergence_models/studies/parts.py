"""``python -m vergence_models.studies.parts --run models/runs/lite --val POOL --json FILE``.

An ablation of `lite`: its errors on held-out clips with one part at a time switched off in the
weights, without training again. A network trained without the part would do better, but this
comparison shows the parts that the shipped weights rely on. Markdown is written beside FILE.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import torch
from rich.progress import track

from vergence_models.config import ConfigError, StepKind
from vergence_models.data.pool import ClipPool
from vergence_models.networks.layers import ConvexUpsampler
from vergence_models.networks.lite.network import LiteNetwork
from vergence_models.studies.networks import TrainingSummary
from vergence_models.studies.tables import Table, TableRow, markdown, write_tables
from vergence_models.training.runs import RunError, read_run, trained_network
from vergence_models.training.validation import START, validate

COLUMNS = {
    f"{kind}_{key}": f"{kind} {label}"
    for kind in ("cold", "warm")
    for key, label in (("epe", "EPE"), ("d1", "D1 %"), ("d3", "D3 %"))
}
NEVER = -1e3  # a logit that rules a hypothesis out
PATIENT = "all of it, 8 iterations on cold frames"
REFINED = "the same, the last 2 of them at 2x"


def rims_never_chosen(network: LiteNetwork) -> None:
    assert network.refinement.choose.bias is not None
    network.refinement.choose.bias[1:] = NEVER  # the first is the surface itself


def never(*hypotheses: int) -> Callable[[LiteNetwork], None]:
    """Never choose these hypotheses at 1/8; they remain inputs of the cell."""

    def rule_out(network: LiteNetwork) -> None:
        assert network.update.out.bias is not None
        network.update.out.bias[list(hypotheses)] = NEVER

    return rule_out


def silenced(*layers: str) -> Callable[[LiteNetwork], None]:
    """Set layers, or parameters, of these names to zero."""

    def silence(network: LiteNetwork) -> None:
        for name, parameter in network.named_parameters():
            if any(name == layer or name.startswith(f"{layer}.") for layer in layers):
                parameter.zero_()

    return silence


def claims_unseen(network: LiteNetwork) -> None:
    network.cost_filter.mutual.zero_()
    network.cost_filter.enter.weight[:, 3] = 0  # the channel of rival matches


def bilinear(network: LiteNetwork) -> None:
    network.refinement.upsample = ConvexUpsampler(network.config.fine_channels).eval()


PARTS: dict[str, Callable[[LiteNetwork], None]] = {
    "all of it": lambda network: None,
    "1/8: no learned residual on the scores": silenced("cost_filter.leave"),
    "1/8: scores do not know the image": silenced("cost_filter.context"),
    "1/8: scores do not know the previous surface": silenced("cost_filter.expected"),
    "1/8: no doubt about matches another surface claims": claims_unseen,
    "1/8: neither the farthest nor the nearest around is chosen": never(3, 4),
    "1/4: no rims, only the surface of 1/8": rims_never_chosen,
    "1/4: no wider view": silenced("refinement.back"),
    "1/4: no sub-pixel fit": silenced("refinement.subpixel"),
    "1/4: no last correction": silenced("refinement.out"),
    "bilinear enlargement": bilinear,
    PATIENT: lambda network: None,
    REFINED: lambda network: None,
}
STARTS = {PATIENT: StepKind(8), REFINED: StepKind(8, at_2x=2)}


def table_of_parts(run_folder: Path, pool: ClipPool, *, clips: int) -> Table:
    """The figures of each variant. Raises RunError, ConfigError."""
    run = read_run(run_folder)
    rows = []
    for label, silence in track(PARTS.items(), description="parts"):
        network = trained_network(run)
        if not isinstance(network, LiteNetwork):
            raise RunError(f"{run_folder}: expected a run of lite, this is {run.config_name}")
        with torch.no_grad():
            silence(network)
        start = STARTS.get(label, START)
        figures = validate(network, pool, torch.device("cpu"), clips=clips, start=start)
        rows.append(TableRow(label, {key: figures[key] for key in COLUMNS}))
    return Table(
        name="parts",
        title="What each part of lite is worth",
        text=f"On {min(clips, len(pool))} held-out clips of the generator, each part silenced in "
        "the weights and nothing trained again. EPE in px; cold frames take 4 iterations, warm "
        "ones 1.",
        columns=COLUMNS,
        rows=rows,
        training=[TrainingSummary.of(run.config_name, "PyTorch", run.story).words],
    )


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="vergence_models.studies.parts",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--run", type=Path, required=True, help="folder of a training run of lite")
    parser.add_argument("--val", type=Path, nargs="+", required=True, help="held-out clips")
    parser.add_argument("--clips", type=int, default=48)
    parser.add_argument("--json", type=Path, required=True)
    given = parser.parse_args(arguments)
    try:
        table = table_of_parts(given.run, ClipPool(*given.val), clips=given.clips)
    except (ConfigError, FileNotFoundError, RunError) as error:
        sys.exit(f"vergence_models.studies.parts: {error}")
    given.json.parent.mkdir(parents=True, exist_ok=True)
    write_tables(given.json, [table])
    given.json.with_suffix(".md").write_text(markdown([table], [], []), "utf-8")
    sys.stdout.write(given.json.with_suffix(".md").read_text("utf-8"))


if __name__ == "__main__":
    main()
