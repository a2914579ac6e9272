"""What a training run leaves in its folder, and reading it back.

``checkpoint.pt`` holds all that going on needs (weights, their moving average, the optimizer, the
random states, how far it came); it is replaced in one rename, so a kill leaves the old one whole.
``log.jsonl`` has a line for every report. Both stay small enough to keep.
"""

from __future__ import annotations

import dataclasses
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from vergence_models.config import Config, ConfigError, NetworkConfig, network_from_dict

CHECKPOINT_NAME = "checkpoint.pt"
CHECKPOINT_FORMAT = 1


class RunError(ValueError):
    """A run's folder lacks its checkpoint, or holds one of another format or configuration."""


@dataclass(slots=True)
class Progress:
    """How far a run has come, over all its sessions."""

    steps: int = 0
    frames: int = 0
    minutes: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """The outcome of a run so far: what export and evaluation need."""

    config_name: str
    network: NetworkConfig
    weights: dict[str, Tensor]  # moving average
    story: dict[str, Any]  # any JSON: command, steps, frames, minutes, device, seed
    measured: dict[str, Any]  # any JSON: the last validation


def save_checkpoint(path: Path, contents: dict[str, Any]) -> None:
    """Replace the checkpoint at ``path`` atomically. ``contents`` is what torch.save takes."""
    partial = path.with_suffix(".partial")
    torch.save({"format": CHECKPOINT_FORMAT, **contents}, partial)
    os.replace(partial, path)


def load_checkpoint(folder: Path) -> dict[str, Any]:
    """The contents of a run's checkpoint. Raises RunError naming the file and what was expected."""
    path = folder / CHECKPOINT_NAME
    if not path.is_file():
        raise RunError(f"no checkpoint at {path}; expected the folder of a training run")
    try:
        contents: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch.load raises a dozen unrelated types on a damaged file
        raise RunError(f"{path}: expected a checkpoint, could not read it: {error}") from error
    if contents.get("format") != CHECKPOINT_FORMAT:
        raise RunError(
            f"{path}: expected checkpoint format {CHECKPOINT_FORMAT}, got {contents.get('format')}"
        )
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
    contents = load_checkpoint(folder)
    return Run(
        config_name=contents["config"],
        network=network_from_dict(
            contents["config"], contents["network"], str(folder / CHECKPOINT_NAME)
        ),
        weights=contents["average"],
        story=contents["story"],
        measured=contents["measured"],
    )
