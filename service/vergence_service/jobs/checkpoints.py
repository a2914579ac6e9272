"""Where a sequence stood when the server died, so that the next one goes on from there.

One file beside the results: a line of JSON, then the state as
:mod:`vergence_service.inference.snapshots`
writes it. It is replaced whole, and only when the results that it speaks of have been written.
"""

import dataclasses
import json
import os
from dataclasses import dataclass
from pathlib import Path

from vergence_proto.accuracy import Accuracy
from vergence_service.inference.model import RecurrentState
from vergence_service.inference.snapshots import state_from_bytes, state_to_bytes


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """A sequence after its first ``frames`` frames."""

    frames: int
    state: RecurrentState  # that they left
    weights_sha256: str  # that it belongs to
    measured: tuple[Accuracy, ...]  # of those frames that have truth


def write_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    about = {
        "frames": checkpoint.frames,
        "weights_sha256": checkpoint.weights_sha256,
        "measured": [dataclasses.asdict(each) for each in checkpoint.measured],
    }
    unfinished = path.with_suffix(".new")
    unfinished.write_bytes(json.dumps(about).encode() + b"\n" + state_to_bytes(checkpoint.state))
    os.replace(unfinished, path)


def read_checkpoint(path: Path) -> Checkpoint | None:
    """None where there is none, or none that is whole: the work is done again then."""
    try:
        first_line, _, state = path.read_bytes().partition(b"\n")
        about = json.loads(first_line)
        return Checkpoint(
            frames=about["frames"],
            state=state_from_bytes(state),
            weights_sha256=about["weights_sha256"],
            measured=tuple(Accuracy(**each) for each in about["measured"]),
        )
    except (FileNotFoundError, KeyError, TypeError, ValueError):  # BadSnapshot is a ValueError
        return None
