"""``python -m vergence_models.train_sigma``: train the sigma of a run; its disparity stays.

    python -m vergence_models.train_sigma --run runs/lite --pool pool/a --val pool/val
    python -m vergence_models.export --run runs/lite --out WEIGHTS --sigma

Sigma is an estimate of the refinement, corrected by the ambiguity of the match. The correction is
small and no other weight depends on it, so it is trained in minutes on pixels of the finished
network, and written into the run's checkpoint. ``train --resume`` goes on from there.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import logging
import shlex
import sys
from pathlib import Path

import torch

from vergence_models.config import TrainingConfig, load_config
from vergence_models.data.pool import ClipPool
from vergence_models.networks.factory import build_network
from vergence_models.networks.lite.network import LiteNetwork
from vergence_models.progress import progress_bar
from vergence_models.training.runs import RunError, carry_over, load_checkpoint, save_checkpoint
from vergence_models.training.sigma_fit import fit_sigma, measured
from vergence_models.training.sigma_samples import SigmaSamples, sigma_samples

log = logging.getLogger("vergence_models.train_sigma")

PART = "sigma_head."


def conditions(training: TrainingConfig) -> TrainingConfig:
    """Those of the samples. Half of the clips show nothing somewhere: most is learned there."""
    return dataclasses.replace(
        training,
        batch=2,
        frames=4,
        blinded_share=0.2,
        unmatched_share=0.08,
        repeating_share=0.2,
        reset_share=0.2,
    )


def parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="vergence_models.train_sigma", description=__doc__)
    add = parser.add_argument
    add("--run", type=Path, required=True, help="folder of a run of lite; its checkpoint changes")
    add("--pool", type=Path, nargs="+", required=True, help="folders of clips, used in turn")
    add("--val", type=Path, nargs="*", default=[], help="folders of held-out clips")
    add("--batches", type=int, default=240, help="batches of two clips to step over")
    add("--val-batches", type=int, default=40)
    add("--steps", type=int, default=4000, help="updates of the weights, on pixels of the batches")
    add("--samples", type=Path, help="folder for the pixels; those that are there are taken")
    add("--seed", type=int, default=1)
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> None:
    given = parse(arguments)
    words = arguments if arguments is not None else sys.argv[1:]
    torch.set_num_threads(1)
    try:
        contents = load_checkpoint(given.run)
    except RunError as error:
        sys.exit(f"vergence_models.train_sigma: {error}")
    config = load_config(contents["config"])
    network = build_network(config.network).eval()
    if not isinstance(network, LiteNetwork):
        sys.exit(f"vergence_models.train_sigma: expected a run of lite, got {config.name!r}")
    carry_over(network, contents["average"], str(given.run))
    with progress_bar(counted=False) as progress:
        logging.basicConfig(level=logging.INFO, format="%(message)s")
        bar = progress.add_task("sigma", total=None, note="")

        def on_step(note: str) -> None:
            progress.update(bar, advance=1, note=note)

        def samples_of(
            name: str, pools: list[Path], batches: int, training: TrainingConfig
        ) -> SigmaSamples:
            path = given.samples and given.samples / f"{name}.pt"
            if path and path.exists():
                return SigmaSamples(*torch.load(path, weights_only=True))
            found = sigma_samples(
                network,
                [ClipPool(folder) for folder in pools],
                training,
                steps=range(batches),
                on_step=on_step,
            )
            if path:
                path.parent.mkdir(parents=True, exist_ok=True)
                torch.save(tuple(found), path)
            return found

        training = dataclasses.replace(conditions(config.training), seed=given.seed)
        samples = samples_of("train", given.pool, given.batches, training)
        fit_sigma(network.sigma_head, samples, steps=given.steps, seed=given.seed, on_step=on_step)
        if given.val:
            # As validation films them: always by flawed cameras, never enlarged.
            held_out = dataclasses.replace(
                training, seed=given.seed + 1, clean_share=0.0, stretch_share=0.0
            )
            samples = samples_of("val", given.val, given.val_batches, held_out)
    figures = measured(network.sigma_head, samples)
    log.info("%s", json.dumps(figures))
    put_into(contents, network)
    contents["story"]["commands"].append(
        shlex.join(["python", "-m", "vergence_models.train_sigma", *words])
    )
    contents["measured"] = {**contents["measured"], "sigma": figures}
    save_checkpoint(given.run, contents)


def put_into(contents: dict[str, object], network: LiteNetwork) -> None:
    """The head's weights, in a checkpoint of a network that may lack them."""
    head = {name: v for name, v in network.state_dict().items() if name.startswith(PART)}
    for part in ("weights", "average"):
        tensors = contents[part]
        assert isinstance(tensors, dict)
        tensors.update({name: value.clone() for name, value in head.items()})
    optimizer = contents["optimizer"]
    assert isinstance(optimizer, dict)
    (group,) = optimizer["param_groups"]
    # They are the last weights, and begin without moments.
    group["params"] = [*range(sum(1 for _ in network.parameters()))]
    for index in group["params"][-len(head) :]:
        optimizer["state"].pop(index, None)


if __name__ == "__main__":
    main()
