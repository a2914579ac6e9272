"""The commands as a person types them, with the weights that ship.

Most run in the process of the tests: a process of their own would spend a second on its imports.
"""

import io
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import chdir, redirect_stderr, redirect_stdout
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

import vergence_native
from tests.support.mjpeg_camera import mjpeg_camera
from tests.support.textured_wall import (
    BASELINE_M,
    DISPARITY_PX,
    FX,
    HEIGHT,
    WIDTH,
    write_pair,
    write_wall,
)
from tests.support.weights_copy import WEIGHTS
from vergence.cli.__main__ import main
from vergence_proto.instruction_set import instruction_set

PATIENCE_S = 60.0
REPOSITORY = Path(__file__).parents[2]


ON_A_TERMINAL = {"COLUMNS": "200", "NO_COLOR": "1"}


def vergence(
    *arguments: object, cwd: Path = REPOSITORY, **environment: str
) -> subprocess.CompletedProcess[str]:
    """Run the command in this process."""
    argv = ["vergence", *map(str, arguments)]
    out, err = io.StringIO(), io.StringIO()
    with (
        pytest.MonkeyPatch.context() as patch,
        chdir(cwd),
        redirect_stdout(out),
        redirect_stderr(err),
    ):
        patch.setattr(sys, "argv", argv)
        for name, value in {**ON_A_TERMINAL, **environment}.items():
            patch.setenv(name, value)
        with pytest.raises(SystemExit) as ended:
            main()
    code = ended.value.code or 0
    assert isinstance(code, int), code
    return subprocess.CompletedProcess(argv, code, out.getvalue(), err.getvalue())


def vergence_without(package: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Run the command in a process of its own, where ``package`` cannot be imported."""
    start = "from vergence.cli.__main__ import main; sys.argv[0] = 'vergence'; main()"
    code = f"import sys; sys.modules[{package!r}] = None; {start}"
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        env={**os.environ, **ON_A_TERMINAL},
        check=False,
    )


@pytest.fixture(scope="module")
def wall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_wall(tmp_path_factory.mktemp("data") / "wall", frames=5)


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    command = [sys.executable, "-m", "vergence_service", "--grpc-port", "0", "--http-port", "0"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as process:
        assert process.stdout is not None
        ready = process.stdout.readline()
        assert ready.startswith("listening grpc="), "the server did not start"
        yield ready.split()[1].removeprefix("grpc=")
        process.terminate()
        assert process.wait(timeout=PATIENCE_S) == 0


def test_demo_ends_with_a_picture_a_video_and_a_table(wall: Path, tmp_path: Path) -> None:
    done = vergence(
        *("demo", "--source", f"vergence:{wall}", "--frames", 3),
        *("--out", tmp_path / "pictures", "--json", tmp_path / "figures.json"),
    )
    assert done.returncode == 0, done.stderr
    assert "EPE" in done.stdout
    figures = json.loads((tmp_path / "figures.json").read_text())
    expected = {"frames", "fps", "latency_p50_ms", "latency_p95_ms", "epe_px", "d1_pct", "d3_pct"}
    assert expected <= figures.keys()
    assert figures["frames"] == 3
    assert figures["fps"] > 0
    assert figures["epe_px"] >= 0
    picture = cv2.imread(str(tmp_path / "pictures" / "demo.png"))
    assert picture is not None
    assert picture.std() > 10
    with av.open(str(tmp_path / "pictures" / "demo.mp4")) as film:
        assert film.streams.video[0].codec_context.name == "h264"  # every browser plays it
        assert sum(1 for _ in film.decode(video=0)) == 3


def test_demo_with_a_running_server_needs_no_other(wall: Path, server: str, tmp_path: Path) -> None:
    done = vergence_without(
        "vergence_service",
        *("demo", "--server", server, "--source", f"vergence:{wall}", "--frames", 2),
        *("--out", tmp_path / "pictures", "--json", tmp_path / "figures.json"),
    )
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "figures.json").read_text())["frames"] == 2


def test_run_writes_every_frame_losslessly(wall: Path, server: str, tmp_path: Path) -> None:
    done = vergence(
        *("run", f"vergence:{wall}", "--server", server, "--out", tmp_path / "out"),
        *("--json", tmp_path / "figures.json", "--pictures"),
    )
    assert done.returncode == 0, done.stderr
    names = [f"{index:04d}.png" for index in range(5)]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        *names,
        "rig.json",
        "sheet.png",
    ]
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert (figures["frames"], figures["frames_dropped"]) == (5, 0)
    errors_px = []
    for name in names:
        stored = cv2.imread(str(tmp_path / "out" / name), cv2.IMREAD_UNCHANGED)
        assert stored is not None
        assert (stored.dtype.name, stored.shape) == ("uint16", (HEIGHT, WIDTH))
        errors_px.append(np.abs(stored / 256 - DISPARITY_PX).mean())
    # The table's figure is that of the files, up to their steps of 1/256 px.
    assert figures["epe_px"] == pytest.approx(np.mean(errors_px), abs=0.01)


def test_run_takes_a_lone_pair_and_starts_a_server_for_it(tmp_path: Path) -> None:
    pair = write_pair(tmp_path / "pair")
    done = vergence(
        *("run", f"vergence:{pair}", "--out", tmp_path / "out", "--json", tmp_path / "j"),
        VERGENCE_MODEL__WEIGHTS=str(WEIGHTS),
        VERGENCE_MODEL__NAME="whole",  # loaded at once
    )
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["disp.png", "rig.json"]
    assert json.loads((tmp_path / "j").read_text())["epe_px"] is None  # the pair has no truth


def test_run_takes_two_images_and_says_what_is_missing(server: str, tmp_path: Path) -> None:
    pair = write_pair(tmp_path / "pair")
    images = (pair / "left.png", pair / "right.png")
    done = vergence("run", *images, "--server", server, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert "without a calibration there is disparity in pixels" in " ".join(done.stdout.split())
    assert sorted(path.name for path in (tmp_path / "out").glob("*.png")) == [
        "disp.png",
        "sheet.png",
    ]
    metres = ("--fx", FX, "--baseline", BASELINE_M, "--no-pictures")
    done = vergence("run", *images, *metres, "--server", server, "--out", tmp_path / "metres")
    assert done.returncode == 0, done.stderr
    assert "without a calibration" not in done.stdout
    disparity, depth = (
        cv2.imread(str(tmp_path / "metres" / name), cv2.IMREAD_UNCHANGED)
        for name in ("disp.png", "depth.png")
    )
    assert disparity is not None
    assert depth is not None
    # Both are stored in steps of 1/256.
    far = disparity > 0
    np.testing.assert_allclose(
        depth[far] / 256, FX * BASELINE_M / (disparity[far] / 256), rtol=0.01
    )


def test_run_reads_a_camera_until_ctrl_c(server: str, tmp_path: Path) -> None:
    with mjpeg_camera(WIDTH, HEIGHT) as address:
        command = [sys.executable, "-m", "vergence", "run", f"camera:{address}"]
        with subprocess.Popen(
            [*command, "--server", server, "--out", str(tmp_path / "out")],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        ) as process:
            eventually_there(tmp_path / "out" / "0002.png")
            process.send_signal(signal.SIGINT)
            said, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, said
    assert "answered" in said
    assert (tmp_path / "out" / "sheet.png").exists()


def eventually_there(path: Path) -> None:
    until_s = time.monotonic() + PATIENCE_S
    while not path.exists():
        assert time.monotonic() < until_s, f"no {path}"
        time.sleep(0.02)


def test_run_at_a_rate_accounts_for_every_frame(server: str, tmp_path: Path) -> None:
    film = write_wall(tmp_path / "film", frames=30)
    done = vergence(
        *("run", f"vergence:{film}", "--server", server, "--out", tmp_path / "out"),
        *("--rate", 2000, "--json", tmp_path / "figures.json"),
    )
    assert done.returncode == 0, done.stderr
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert figures["frames"] + figures["frames_dropped"] == 30
    assert figures["frames_dropped"] > 0  # thirty frames in 15 ms are more than the credit
    assert len(list((tmp_path / "out").glob("*.png"))) == figures["frames"]
    assert "at the source" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "code", "expected"),
    [
        (["run", "nonsense"], 2, "expected one of vergence:PATH"),
        (["run", "vergence:/nowhere/at/all"], 2, "no such folder"),
        (["run", "WALL", "--rate", "soon"], 2, "expected a rate in Hz, source or max"),
        (["run", "WALL", "--server", "http://x"], 2, "expected a server as grpc://HOST:PORT"),
        (["run", "WALL", "--server", "127.0.0.1:1"], 1, "no connection to 127.0.0.1:1"),
        (["run", "WALL", "--out", "/dev/null/here"], 1, "/dev/null/here"),
        (["demo", "--server", "127.0.0.1:1"], 1, "no connection to 127.0.0.1:1"),
        (["demo", "--source", "kitti:here"], 2, "expected KITTI's camera projections"),
    ],
    ids=["kind", "folder", "rate", "scheme", "nobody-there", "unwritable", "demo-alone", "demo"],
)
def test_what_a_person_got_wrong_is_reported_without_a_trace(
    wall: Path, tmp_path: Path, arguments: list[str], code: int, expected: str
) -> None:
    done = vergence(
        *(f"vergence:{wall}" if argument == "WALL" else argument for argument in arguments),
        cwd=tmp_path,
    )
    assert done.returncode == code
    assert expected in done.stderr
    assert "Traceback" not in done.stderr


def test_a_damaged_frame_in_the_middle_is_named(server: str, tmp_path: Path) -> None:
    film = write_wall(tmp_path / "film", frames=3)
    damaged = film / "frame_0001_right.png"
    damaged.write_bytes(damaged.read_bytes()[:200])
    done = vergence("run", f"vergence:{film}", "--server", server, "--out", tmp_path / "out")
    assert done.returncode == 1
    assert "1 of 3 frames lack a file" in done.stderr
    assert str(damaged) in done.stderr
    assert "Traceback" not in done.stderr
    names = sorted(path.name for path in (tmp_path / "out").glob("*.png"))
    assert names == ["0000.png", "0002.png"]


def test_run_writes_the_maps_and_values_that_are_asked_for(
    wall: Path, server: str, tmp_path: Path
) -> None:
    wall_m = FX * BASELINE_M / DISPARITY_PX  # errors place a part of the wall further away
    outputs = (f"--output={each}" for each in ("disparity", "depth", "sigma", "confidence"))
    done = vergence(
        *("run", f"vergence:{wall}", "--server", server, "--out", tmp_path, "--frames", 2),
        *outputs,
        *("--min-confidence", 120, "--max-depth", wall_m, "--speckle", 30, "--format", "npz"),
        *("--json", tmp_path / "figures.json"),
    )
    assert done.returncode == 0, done.stderr
    with np.load(tmp_path / "0001.npz") as arrays:
        kept = np.isfinite(arrays["disparity"])
        assert {*arrays} == {"disparity", "depth", "sigma", "confidence"}
        assert arrays["confidence"][kept].min() >= 120
        assert np.nanmax(arrays["depth"]) <= wall_m
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert 0 < figures["kept_pct"] < 100


@pytest.mark.parametrize(
    ("missing", "arguments", "extra"),
    [
        ("typer", ["--version"], "vergence[cli]"),
        ("rich", ["doctor"], "vergence[cli]"),
        ("fastapi", ["serve"], "vergence[server]"),
    ],
)
def test_what_is_not_installed_is_reported_with_the_extra_that_brings_it(
    missing: str, arguments: list[str], extra: str
) -> None:
    done = vergence_without(missing, *arguments)
    assert done.returncode == 1
    assert missing in done.stderr
    assert extra in done.stderr
    assert "Traceback" not in done.stderr


def test_no_server_to_start_is_reported_with_the_extra_that_brings_it(
    wall: Path, tmp_path: Path
) -> None:
    done = vergence_without(
        "vergence_service", "run", f"vergence:{wall}", "--out", tmp_path / "out"
    )
    assert done.returncode == 1
    assert "vergence[server]" in done.stderr


def test_a_server_that_does_not_start_is_quoted(wall: Path, tmp_path: Path) -> None:
    done = vergence("run", f"vergence:{wall}", cwd=tmp_path, VERGENCE_MODEL__NAME="grand")
    assert done.returncode == 1
    assert "the server did not start" in done.stderr
    assert "no model 'grand'" in done.stderr
    assert "Traceback" not in done.stderr


def test_doctor_finds_the_weights_and_a_running_server(server: str) -> None:
    done = vergence("doctor", "--server", server, "--seconds", 1)
    assert done.returncode == 0, done.stdout
    assert "lite" in done.stdout
    assert f"{server} runs" in done.stdout
    found = "built; it serves lite" if vergence_native.available() else "onnxruntime serves"
    assert found in " ".join(done.stdout.split())
    # The client and the server are on one machine, so both lines name its processor.
    assert done.stdout.count(instruction_set()) >= 2


def test_help_of_a_contributed_command_is_its_own() -> None:
    done = vergence("serve", "--help")
    assert done.returncode == 0
    assert "--print-config" in done.stdout
