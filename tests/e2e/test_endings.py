"""However a command ends, the server that it started ends with it."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from tests.support.textured_wall import write_wall
from tests.support.weights_copy import WEIGHTS

PATIENCE_S = 60.0

pytestmark = pytest.mark.skipif(
    not Path("/proc/self/task").exists(), reason="finds processes in /proc"
)


def _wait_for(condition: Callable[[], bool], what: str) -> None:
    until_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < until_s, what
        time.sleep(0.05)


def _has_results(folder: Path) -> bool:
    return any(folder.glob("*.png"))


def _children(process: subprocess.Popen[bytes]) -> list[int]:
    listed = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    return [int(pid) for pid in listed.read_text().split()]


def _has_ended(pid: int) -> bool:
    """A process that has ended stays a zombie where nobody waits for it."""
    try:
        status = Path(f"/proc/{pid}/stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return True
    return status.rpartition(")")[2].split()[0] == "Z"


def _ignore_hangups() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does


def _hear_hangups() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # the tests themselves may run under nohup


@pytest.mark.parametrize(
    "names",
    [
        ("SIGTERM", "SIGKILL"),
        pytest.param(("nohup", "SIGTERM", "SIGHUP", "SIGKILL"), marks=pytest.mark.slow),
    ],
    ids=" ".join,
)
def test_no_server_outlives_the_command_that_started_it(
    tmp_path: Path, names: tuple[str, ...]
) -> None:
    ends = {
        # First: this one ends by itself, after three seconds.
        "nohup": (write_wall(tmp_path / "short", frames=4), 0),
        "SIGTERM": (write_wall(tmp_path / "wall", frames=60), 128 + signal.SIGTERM),
        "SIGHUP": (tmp_path / "wall", 128 + signal.SIGHUP),
        "SIGKILL": (tmp_path / "wall", -signal.SIGKILL),
    }
    model = {"VERGENCE_MODEL__WEIGHTS": str(WEIGHTS), "VERGENCE_MODEL__NAME": "whole"}
    commands = {}
    for name in names:  # all at once: each start takes seconds
        source, _ = ends[name]
        run = [sys.executable, "-m", "vergence.cli", "run", f"vergence:{source}", "--rate", "1"]
        commands[name] = subprocess.Popen(
            [*run, "--out", str(tmp_path / name)],
            env={**os.environ, **model},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            preexec_fn=_ignore_hangups if name == "nohup" else _hear_hangups,
        )
    servers = {}
    try:
        for name, process in commands.items():
            _wait_for(partial(_has_results, tmp_path / name), f"{name}: no result")
            (servers[name],) = _children(process)
            process.send_signal(getattr(signal, name, signal.SIGHUP))
        for name, process in commands.items():
            assert process.wait(PATIENCE_S) == ends[name][1], name
            _wait_for(partial(_has_ended, servers[name]), f"{name}: the server goes on")
    finally:
        for process in commands.values():
            process.kill()
            process.wait()
