"""Checkpoints of a running sequence, so that the next server can continue it after a crash.

A checkpoint is one file beside the results: a line of JSON, then the state as
:mod:`vergence_service.inference.snapshots` writes it. The file is replaced as a whole, and only
after the results of its frames have been written.
"""

import json
import os
from dataclasses import dataclass
from pathlib import Path

from vergence_service.inference.model import RecurrentState
from vergence_service.inference.snapshots import state_from_bytes, state_to_bytes
from vergence_service.jobs.tally import FrameCounts

_LONGEST_LINE = 64 << 20  # it lists the accuracy of every frame


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """A sequence after its first ``frames`` frames."""

    frames: int
    state: RecurrentState  # state after these frames
    weights_sha256: str  # weights that the state belongs to
    tally: FrameCounts  # what these frames add up to


def write_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Replace the checkpoint at ``path``."""
    about = {
        "frames": checkpoint.frames,
        "weights_sha256": checkpoint.weights_sha256,
        "tally": checkpoint.tally.to_values(),
    }
    unfinished = path.with_suffix(".new")
    unfinished.write_bytes(json.dumps(about).encode() + b"\n" + state_to_bytes(checkpoint.state))
    os.replace(unfinished, path)


def saved_frames(path: Path) -> int:
    """Return the number of frames of a checkpoint; 0 if it is missing or damaged."""
    try:
        with path.open("rb") as file:
            return int(json.loads(file.readline(_LONGEST_LINE))["frames"])
    except (OSError, KeyError, TypeError, ValueError):
        return 0


def read_checkpoint(path: Path) -> Checkpoint | None:
    """Return the checkpoint, or None if it is missing or damaged: the work is then done again."""
    try:
        first_line, _, state = path.read_bytes().partition(b"\n")
        about = json.loads(first_line)
        return Checkpoint(
            frames=about["frames"],
            state=state_from_bytes(state),
            weights_sha256=about["weights_sha256"],
            tally=FrameCounts.from_values(about["tally"]),
        )
    except (FileNotFoundError, KeyError, TypeError, ValueError):  # BadSnapshot is a ValueError
        return None
