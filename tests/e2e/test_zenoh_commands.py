"""The commands over Zenoh, as a person types them, with the weights that ship."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.e2e.test_commands import vergence, vergence_without
from tests.support.textured_wall import write_wall
from tests.support.zenoh_net import address_of, free_endpoint

PATIENCE_S = 60.0


@pytest.fixture(scope="module")
def addresses() -> Iterator[list[str]]:
    """The addresses of one server, over gRPC and over Zenoh."""
    endpoint = free_endpoint()
    with subprocess.Popen(
        [
            *(sys.executable, "-m", "vergence_service", "--zenoh"),
            *("--grpc-port", "0", "--http-port", "0"),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env={**os.environ, "VERGENCE_ZENOH__LISTEN": f'["{endpoint}"]'},
    ) as process:
        assert process.stdout is not None
        _, grpc, _, zenoh = process.stdout.readline().split()
        assert zenoh == f"zenoh={endpoint}"
        yield [grpc.removeprefix("grpc="), address_of(endpoint)]
        process.terminate()
        assert process.wait(timeout=PATIENCE_S) == 0


def test_run_writes_the_same_files_through_every_door(addresses: list[str], tmp_path: Path) -> None:
    wall = write_wall(tmp_path / "wall", frames=4)
    written: list[dict[str, bytes]] = []
    for index, address in enumerate(addresses):
        out = tmp_path / str(index)
        done = vergence("run", f"vergence:{wall}", "--server", address, "--out", out)
        assert done.returncode == 0, done.stderr
        written.append({file.name: file.read_bytes() for file in out.glob("*.png")})
    assert len(written[0]) == 4
    assert written[0] == written[1]


def test_without_the_extra_it_is_said_how_to_install_it() -> None:
    for command in (
        ("serve", "--zenoh", "--grpc-port", 0, "--http-port", 0),
        ("doctor", "--server", "zenoh://127.0.0.1:1"),
    ):
        done = vergence_without("zenoh", *command)
        assert done.returncode == 2
        assert "pip install 'vergence[zenoh]'" in done.stderr
