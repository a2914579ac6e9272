"""The C++ client, built and run against a server. CI runs it: ``pytest client/examples/cpp``.

It needs Debian's g++, cmake, pkg-config, libgrpc++-dev, protobuf-compiler-grpc and libzstd-dev.
"""

import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from subprocess import PIPE, Popen

import cv2
import numpy as np
import pytest

import vergence
from vergence_proto.datasets import open_source

HERE = Path(__file__).parent
ROOM = HERE.parents[1] / "vergence/sample/room"
PATIENCE_S = 120.0
LISTENING = re.compile(r"listening grpc=(\S+:)(\d+)")
LINE = re.compile(r"frame (\d+): (\d+)x(\d+), median ([\d.]+) m, (warm|cold)")


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The client, built."""
    build = tmp_path_factory.mktemp("build")
    subprocess.run(["cmake", "-S", HERE, "-B", build, "-DCMAKE_BUILD_TYPE=Release"], check=True)
    subprocess.run(["cmake", "--build", build], check=True)
    return build / "depth_client"


@contextmanager
def serving(folder: Path, port: int = 0) -> Iterator[int]:
    """A server with the weights that ship, killed at the end; its port."""
    command = [sys.executable, "-m", "vergence_service", "--grpc-port", str(port), "--http-port"]
    settings = {"VERGENCE_BATCH__DIRECTORY": str(folder), "PYTHONPATH": ":".join(sys.path)}
    with Popen([*command, "0"], env=settings, stdout=PIPE, text=True) as server:
        assert server.stdout is not None
        listening = next(filter(None, map(LISTENING.search, server.stdout)), None)
        assert listening is not None, "the server did not start"
        try:
            yield int(listening[2])
        finally:
            server.kill()


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """The program's arguments for the first pair of the bundled room."""
    folder = tmp_path_factory.mktemp("pair")
    source = open_source(f"vergence:{ROOM}")
    frame, rig = source[0].frame, source.rig.as_rectified()
    assert rig is not None
    for name, image in (("left", frame.left), ("right", frame.right)):
        cv2.imwrite(str(folder / f"{name}.pgm"), cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    numbers = (rig.fx, rig.cx_left, rig.cy, rig.baseline_m)
    return [str(folder / "left.pgm"), str(folder / "right.pgm"), *map(str, numbers)]


def test_it_sees_the_depth_that_python_sees(program: Path, pair: list[str], tmp_path: Path) -> None:
    with serving(tmp_path) as port:
        address = f"127.0.0.1:{port}"
        ended = subprocess.run(
            [program, address, *pair, "5"],
            stdout=PIPE,
            text=True,
            timeout=PATIENCE_S,
            check=True,
        )
        left, right = (cv2.imread(path, cv2.IMREAD_GRAYSCALE) for path in pair[:2])
        assert left is not None
        assert right is not None
        rig = open_source(f"vergence:{ROOM}").rig
        expected_m = float(
            np.nanmedian(
                vergence.depth(
                    left.astype(np.uint8), right.astype(np.uint8), rig, server=address
                ).depth_m
            )
        )
    results = [LINE.match(line) for line in ended.stdout.splitlines()]
    assert len(results) >= 2
    for result in results:
        assert result is not None
        assert result.group(2, 3) == ("640", "480")
        assert float(result[4]) == pytest.approx(expected_m, rel=0.02)
    assert results[-1] is not None
    assert results[-1][5] == "warm"


def test_it_goes_on_with_a_server_that_was_killed_and_started_again(
    program: Path, pair: list[str], tmp_path: Path
) -> None:
    with serving(tmp_path / "first") as port:
        command = [program, f"127.0.0.1:{port}", *pair, "1000000"]
        client = Popen(command, stdout=PIPE, stderr=PIPE, text=True)
        assert client.stdout is not None
        for _ in range(10):
            shown = LINE.match(client.stdout.readline())
            assert shown
    with client, serving(tmp_path / "second", port):
        # A new server does not know the stream: it begins again with frame 1, and is warm soon. Of
        # results that come together, the program shows the newest.
        results = (found for found in map(LINE.match, client.stdout) if found)
        latest = int(shown[1])
        while (frame_id := int(next(results)[1])) >= latest:
            latest = frame_id
        assert "warm" in (found[5] for found in results)
        assert client.poll() is None
        client.kill()


def test_what_cannot_be_is_said_in_one_sentence(program: Path, pair: list[str]) -> None:
    wrong = subprocess.run(
        [program, "127.0.0.1:1", __file__, *pair[1:], "1"], stderr=PIPE, text=True, check=False
    )
    assert wrong.returncode == 1
    assert "expected a PGM of 8 bits" in wrong.stderr
