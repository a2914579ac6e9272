"""Sequences on a Ray cluster give the results of one machine, also when an actor is killed."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.e2e.test_commands import vergence
from tests.support.sequences import make_frames, write_sequence

pytestmark = pytest.mark.slow  # it needs Ray, and starts a cluster
SEQUENCES = 8
MODEL = "sgbm-half"  # it starts at once


def maps_of(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*.png")}


def test_an_actor_is_killed_and_every_result_is_that_of_one_machine(tmp_path: Path) -> None:
    for number in range(SEQUENCES):
        frames = make_frames(4, brightness=20 + 5 * number)
        write_sequence(tmp_path / "in" / f"room-{number}", frames)
    one = vergence("batch", tmp_path / "in", "--out", tmp_path / "one", VERGENCE_MODEL__NAME=MODEL)
    assert one.returncode == 0, one.stderr
    cluster = subprocess.run(
        [sys.executable, "-m", "tests.support.ray_cluster", tmp_path / "in", tmp_path / "ray"],
        cwd=Path(__file__).parents[2],
        env={**os.environ, "VERGENCE_MODEL__NAME": MODEL},
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert cluster.returncode == 0, cluster.stderr[-2000:]
    assert "killed" in cluster.stdout
    assert "errors []" in cluster.stdout
    expected = maps_of(tmp_path / "one")
    assert len(expected) == 4 * SEQUENCES
    assert maps_of(tmp_path / "ray") == expected
