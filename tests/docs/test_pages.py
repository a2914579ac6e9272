"""The law of documentation: what a page shows works as it stands there."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from subprocess import PIPE, Popen

import pytest

from tests.docs.pages import PAGES, ROOT, blocks_of, commands_of
from tests.support.short_room import ROOM, link_short_room
from tests.support.weights_copy import WEIGHTS

# The ports that pages name; each run has a server of its own on free ones.
_PORTS = {"grpc": "50051", "http": "8000", "zenoh": "7447"}
_LISTENING = re.compile(
    r"listening grpc=\S+:(?P<grpc>\d+) http=\S+:(?P<http>\d+)(?: zenoh=\S+:(?P<zenoh>\d+))?"
)
_PATIENCE_S = 100.0
_ON_FREE_PORTS = ("--grpc-port", "0", "--http-port", "0")
_FREE_ENDPOINT = '["tcp/127.0.0.1:0"]'
SAMPLE = ROOM.relative_to(ROOT)
SAMPLE_FRAMES = 3

_EVERYTHING = "vergence serve --zenoh"

Ports = dict[str, str]


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """``vergence`` and ``python`` on the path are those of this checkout, with a small network.

    ``client`` of the current folder comes first: it has the short sample.
    """
    binaries = tmp_path_factory.mktemp("bin")
    for name, arguments in {"vergence": "-m vergence.cli", "python": ""}.items():
        command = binaries / name
        command.write_text(f'#!/bin/sh\nexec "{sys.executable}" {arguments} "$@"\n')
        command.chmod(0o755)
    return {
        **os.environ,
        "PATH": f"{binaries}:{os.environ['PATH']}",
        "PYTHONPATH": os.pathsep.join(["client", *filter(None, sys.path), str(ROOT)]),
        "VERGENCE_MODEL__WEIGHTS": str(WEIGHTS),
        "VERGENCE_MODEL__NAME": "whole",
        "VERGENCE_BATCH__DIRECTORY": str(tmp_path_factory.mktemp("jobs")),
        "VERGENCE_ZENOH__LISTEN": _FREE_ENDPOINT,
    }


@pytest.fixture(scope="module")
def ports(environment: dict[str, str]) -> Iterator[Ports]:
    """A server that speaks everything, started as the pages say; its ports by transport."""
    command = ["bash", "-c", f"exec {_EVERYTHING} {' '.join(_ON_FREE_PORTS)}"]
    with Popen(command, env=environment, stdout=PIPE, text=True) as server:
        assert server.stdout is not None
        listening = next(filter(None, map(_LISTENING.search, server.stdout)), None)
        assert listening is not None, "the server did not start"
        yield listening.groupdict()
        server.terminate()


@pytest.fixture(scope="module")
def have_served(ports: Ports) -> set[str]:
    """The commands that have started a server already: each is started once for all pages."""
    return {_EVERYTHING}


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A folder that looks like the checkout, in which commands may write.

    Its bundled sequence has only the first frames: what the pages do with it takes less time.
    """
    link_all(ROOT, tmp_path, apart_from=SAMPLE.parents)
    link_short_room(tmp_path / SAMPLE, frames=SAMPLE_FRAMES)
    return tmp_path


def link_all(source: Path, target: Path, *, apart_from: Sequence[Path]) -> None:
    """Link what is in ``source``, but make the folders ``apart_from``, relative to ROOT."""
    target.mkdir(exist_ok=True)
    for entry in source.iterdir():
        if entry == ROOM:
            continue
        if entry.relative_to(ROOT) in apart_from:
            link_all(entry, target / entry.name, apart_from=apart_from)
        elif not entry.name.startswith("."):
            (target / entry.name).symlink_to(entry)


def at_these(ports: Ports, text: str) -> str:
    """The text with the ports of the running server in place of the usual ones."""
    for transport, usual in _PORTS.items():
        text = re.sub(rf"(?<=:){usual}\b", ports[transport], text)
    return text


def pages_with(*languages: str) -> list[Path]:
    return [
        page for page in PAGES if any(each.reason is None for each in blocks_of(page, *languages))
    ]


@pytest.mark.parametrize("page", pages_with("python"), ids=str)
def test_every_python_block_runs(
    page: Path, checkout: Path, environment: dict[str, str], ports: Ports
) -> None:
    sources = [at_these(ports, each.code) for each in blocks_of(page, "python") if not each.reason]
    (checkout / "blocks.json").write_text(json.dumps(sources))
    run(
        [sys.executable, "-m", "tests.docs.run_blocks", "blocks.json"],
        checkout,
        environment,
    )


# The page of the models evaluates the network that ships, which takes ten seconds.
@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=[pytest.mark.slow] * (page != ROOT / "README.md"))
        for page in pages_with("sh")
    ],
    ids=str,
)
def test_every_shell_line_runs(
    page: Path, checkout: Path, environment: dict[str, str], ports: Ports, have_served: set[str]
) -> None:
    for block in blocks_of(page, "sh"):
        for command in commands_of(block) if block.reason is None else []:
            if command.startswith("pip install"):
                check_extras(command)
            elif (
                re.match(r"(\w+=\S+ )*vergence serve", command) and "--print-config" not in command
            ):
                serving = command.rstrip("& ")
                if serving not in have_served:
                    check_it_serves(serving, checkout, environment)
                    have_served.add(serving)
            else:
                run(["bash", "-c", at_these(ports, command)], checkout, environment)


def run(command: list[str], checkout: Path, environment: dict[str, str]) -> None:
    ended = subprocess.run(
        command,
        cwd=checkout,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=_PATIENCE_S,
        check=False,
    )
    assert ended.returncode == 0, f"{command[-1]}\n{ended.stdout[-3000:]}"


def check_extras(command: str) -> None:
    """An installation is not run; what it asks for must exist."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    for asked in re.findall(r"\[([\w,]+)\]", command):
        assert set(asked.split(",")) <= set(extras), command


def check_it_serves(command: str, checkout: Path, environment: dict[str, str]) -> None:
    line = f"exec {command} {' '.join(_ON_FREE_PORTS)}"
    line = re.sub(r"^exec ((?:\w+=\S+ )+)", r"exec env \1", line)
    with Popen(
        ["bash", "-c", line], cwd=checkout, env=environment, stdout=PIPE, text=True
    ) as server:
        assert server.stdout is not None
        listening = any(map(_LISTENING.search, server.stdout))
        server.terminate()
        assert listening, f"{command}: the server did not start"


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) <= 130


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_every_link_to_a_file_leads_somewhere(page: Path) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    targets = re.findall(r"\]\((?!\w+:)([^)#\s]+)", text)
    missing = [each for each in targets if not (ROOT / page.parent / each).exists()]
    assert missing == []


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_a_block_that_is_not_run_says_why(page: Path) -> None:
    for block in blocks_of(page, "python", "sh"):
        assert block.reason is None or len(block.reason.split()) >= 2, f"{page}:{block.line}"
