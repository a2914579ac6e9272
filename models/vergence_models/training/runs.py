"""The files of a training run, written and read.

``checkpoint.pt`` holds everything that a resumed run needs: weights, their moving average, the
optimizer, the random states and the progress. It is replaced in one rename, so a killed process
leaves the old file whole. The large tensors of large networks lie in shards beside it: export needs
``average-*``; a resumed run also needs ``weights-*`` and ``optimizer-*``. ``log.jsonl`` has a line
for every report.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from vergence_models.config import Config, ConfigError, NetworkConfig, network_from_dict
from vergence_models.networks.base import AnyNetwork
from vergence_models.networks.factory import build_network
from vergence_models.training.checkpoint_shards import HALF, SHARD_BYTES, joined, split, tensors_of

CHECKPOINT_NAME = "checkpoint.pt"
LOG_NAME = "log.jsonl"
WHOLE_FORMAT = 1  # everything in one file
SHARDED_FORMAT = 2  # an index, and the large tensors beside it


class RunError(ValueError):
    """A run's folder has no checkpoint, or one of another format or configuration."""


@dataclass(slots=True)
class TrainingProgress:
    """Totals of a run, over all its sessions."""

    steps: int = 0
    frames: int = 0
    minutes: float = 0.0


@dataclass(frozen=True, slots=True)
class Validation:
    """The errors of a validation after so many steps, by name, as ``validate`` returns them."""

    steps: int
    measured: dict[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """The part of a run that export and evaluation need."""

    config_name: str
    network: NetworkConfig
    weights: dict[str, Tensor]  # moving average
    story: dict[str, Any]  # any JSON: command, steps, frames, minutes, device, seed
    measured: dict[str, Any]  # any JSON: the last validation
    source: str = "a run"  # the checkpoint's path, for error messages
    history: list[Validation] = field(default_factory=list)


def save_checkpoint(folder: Path, contents: dict[str, Any]) -> None:
    """Replace a run's checkpoint. ``contents`` is what torch.save takes, with its ``progress``."""
    if sum(tensor.nbytes for tensor in tensors_of(contents)) < SHARD_BYTES:
        save(folder / CHECKPOINT_NAME, {"format": WHOLE_FORMAT, **contents})
        return
    index = {"format": SHARDED_FORMAT, **contents}
    names: dict[str, list[str]] = {}
    for part, half in HALF.items():
        index[part], shards = split(contents[part], half)
        # New names for new shards: the old ones stay valid until the index is replaced.
        steps = contents["progress"]["steps"]
        names[part] = [f"{part}-{steps:08d}-{number}.pt" for number in range(len(shards))]
        for name, shard in zip(names[part], shards, strict=True):
            save(folder / name, shard)
    # "pieces" is the key of the format on disk: older runs have it.
    save(folder / CHECKPOINT_NAME, {**index, "pieces": names})
    kept = {name for part in names.values() for name in part}
    for part in HALF:
        for path in folder.glob(f"{part}-????????-*.pt"):
            if path.name not in kept:
                path.unlink()


def save(path: Path, contents: dict[str, Any]) -> None:
    """Write a file that is whole or not there."""
    partial = path.with_suffix(".partial")
    torch.save(contents, partial)
    os.replace(partial, path)


def load_checkpoint(folder: Path, parts: Collection[str] = HALF) -> dict[str, Any]:
    """The contents of a run's checkpoint; of large ``parts`` only those asked for are read.

    Raises RunError naming the file and what was expected.
    """
    path = folder / CHECKPOINT_NAME
    if not path.is_file():
        raise RunError(f"no checkpoint at {path}; expected the folder of a training run")
    contents = load(path)
    if contents.get("format") == WHOLE_FORMAT:
        return contents
    if contents.get("format") != SHARDED_FORMAT:
        raise RunError(
            f"{path}: expected checkpoint format {WHOLE_FORMAT} or {SHARDED_FORMAT}, "
            f"got {contents.get('format')}"
        )
    for part in parts:
        tensors: dict[str, Tensor] = {}
        for name in contents["pieces"][part]:
            if not (folder / name).is_file():
                raise RunError(f"no {folder / name}; {path} expects it beside itself")
            tensors.update(load(folder / name))
        contents[part] = joined(contents[part], tensors)
    return contents


def load(path: Path) -> dict[str, Any]:
    try:
        contents: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch.load raises a dozen unrelated types on a damaged file
        raise RunError(f"{path}: expected a checkpoint, could not read it: {error}") from error
    return contents


def require_same_network(contents: dict[str, Any], config: Config, path: Path) -> None:
    """Raise RunError unless a checkpoint was made with ``config``'s tier and network."""
    if contents["config"] != config.name:
        raise RunError(
            f"{path}: expected a run of configuration {config.name!r}, got {contents['config']!r}"
        )
    try:
        network = network_from_dict(config.name, contents["network"], str(path))
    except ConfigError as error:
        raise RunError(str(error)) from None
    for entry in dataclasses.fields(config.network):
        expected, got = getattr(config.network, entry.name), getattr(network, entry.name)
        if expected != got:
            raise RunError(f"{path}: expected {entry.name} = {expected}, the run has {got}")


def read_run(folder: Path) -> Run:
    """Load a run for export or evaluation. Raises RunError."""
    contents = load_checkpoint(folder, parts=["average"])
    source = str(folder / CHECKPOINT_NAME)
    return Run(
        config_name=contents["config"],
        network=network_from_dict(contents["config"], contents["network"], source),
        weights=contents["average"],
        story=contents["story"],
        measured=contents["measured"],
        source=source,
        history=read_history(folder),
    )


def read_history(folder: Path) -> list[Validation]:
    """Every validation in a run's log; none without a log. Raises RunError."""
    path = folder / LOG_NAME
    if not path.is_file():
        return []
    try:
        lines = [json.loads(line) for line in path.read_text("utf-8").splitlines()]
        return [Validation(x["step"], x["validation"]) for x in lines if "validation" in x]
    except (ValueError, KeyError, TypeError) as error:
        raise RunError(f"{path}: expected a line of JSON for every report: {error!r}") from None


def load_weights(network: AnyNetwork, weights: Mapping[str, Tensor], source: str) -> None:
    """Load the weights of a run into a network. Raises RunError if the architecture differs.

    Architectures change while configurations keep their names; only the shapes show it.
    """
    expected = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    got = {name: tuple(tensor.shape) for name, tensor in weights.items()}
    for name in sorted(expected | got):
        if expected.get(name) != got.get(name):
            raise RunError(
                f"{source}: expected weights of the present architecture, these are of another: "
                f"{name} is {got.get(name, 'missing')}, expected {expected.get(name, 'none')}; "
                "use the version of the project they were trained with"
            )
    network.load_state_dict(weights)


def carry_over(network: AnyNetwork, weights: Mapping[str, Tensor], source: str) -> list[str]:
    """Load the weights of a run that has fewer parts; returns the names of what it lacks.

    Those stay as the network has them. Raises RunError if a weight has no place in the network.
    """
    present = network.state_dict()
    load_weights(network, {**present, **weights}, source)
    return sorted(present.keys() - weights.keys())


def trained_network(run: Run) -> AnyNetwork:
    """The averaged weights of a run, for inference. Raises RunError."""
    network = build_network(run.network).eval()
    load_weights(network, run.weights, run.source)
    return network
