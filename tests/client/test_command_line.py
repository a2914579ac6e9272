"""What the command line itself promises: quick help, completion, hints that install something."""

import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path
from typing import get_args

import pytest
from typer.testing import CliRunner

from vergence.cli.app import app
from vergence_proto.extras import Extra, how_to_install

ROOT = Path(__file__).parents[2]
COMMANDS = ["demo", "run", "batch", "doctor", "serve"]
SLOW = {"asyncio", "cv2", "fastapi", "grpc", "httpx", "numpy", "onnxruntime", "pydantic_settings"}


@pytest.mark.parametrize(
    "arguments", [["--help"], ["--version"], ["serve", "--help"]], ids=" ".join
)
def test_help_loads_nothing_slow(arguments: list[str]) -> None:
    code = (
        "import atexit, sys; sys.argv[0] = 'vergence'; "
        "atexit.register(lambda: print('loaded', *{n.partition('.')[0] for n in sys.modules})); "
        "from vergence.cli.__main__ import main; main()"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=True
    )
    loaded = done.stdout.rpartition("loaded")[2].split()
    assert "typer" in loaded
    assert not SLOW & set(loaded)


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_the_short_flag_of_help_is_the_long_one(command: str) -> None:
    short, long = (
        CliRunner().invoke(app, [*command.split(), flag]).output for flag in ("-h", "--help")
    )
    assert short == long
    assert "Usage:" in short


def test_no_program_of_the_tree_is_without_the_short_flag() -> None:
    # argparse always knows it.
    sources = [
        path
        for folder in ("client", "models", "proto", "service", "tests")
        for path in (ROOT / folder).rglob("*.py")
    ]
    assert [path for path in sources if "typer" + ".run(" in path.read_text("utf-8")] == []


@pytest.mark.parametrize(
    ("words", "expected"),
    [("vergence ser", "serve"), ("vergence serve --grpc", "--grpc-port")],
    ids=["command", "flag"],
)
def test_a_shell_completes(words: str, expected: str) -> None:
    done = CliRunner().invoke(
        app,
        prog_name="vergence",
        env={
            "_VERGENCE_COMPLETE": "complete_bash",
            "COMP_WORDS": words,
            "COMP_CWORD": str(len(words.split()) - 1),
        },
    )
    assert done.output.split() == [expected]


def test_every_hint_names_an_extra_that_pip_finds() -> None:
    known = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert set(get_args(Extra)) <= set(known["optional-dependencies"])
    wanted = [how_to_install(extra).split("'")[1] for extra in get_args(Extra)]
    pip = [sys.executable, "-m", "pip", "install", "--no-index", "--no-deps", "--dry-run"]
    done = subprocess.run([*pip, *wanted], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "does not provide the extra" not in done.stderr


def test_the_hint_for_a_tree_that_is_not_installed_names_its_folder(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def nothing(name: str) -> None:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "distribution", nothing)
    assert how_to_install("server") == f"pip install -e '{ROOT}[server]'"
