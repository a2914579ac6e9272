"""`vergence doctor KIND:PATH` on recordings in folders: a mistake is named, and no other."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.support.mistaken_rooms import MISTAKES, room, rows_apart, swapped, write_sequence
from vergence.cli.app import app
from vergence.source_check import Mistake
from vergence_proto.datasets import StereoSource


def doctor(folder: Path) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["doctor", f"vergence:{folder}"])
    return done.exit_code, " ".join(done.output.split())


def test_swapped_eyes_are_named(tmp_path: Path) -> None:
    few = replace(swapped(), files=swapped().files[:4])
    code, output = doctor(write_sequence(few, tmp_path / "room"))
    assert code == 1
    assert output.startswith(f"{Mistake.SWAPPED_EYES}: ")
    assert "exchange left and right" in output


@pytest.mark.slow
@pytest.mark.parametrize(("source", "mistake", "words"), MISTAKES)
def test_each_mistake_is_named(
    source: Callable[[], StereoSource], mistake: Mistake, words: str, tmp_path: Path
) -> None:
    code, output = doctor(write_sequence(source(), tmp_path / "room"))
    assert code == 1
    assert output.startswith(f"{mistake}: ")
    assert words in output


@pytest.mark.slow
def test_rows_that_do_not_correspond_are_named(tmp_path: Path) -> None:
    lowered = rows_apart(tmp_path, frames=len(room()))
    code, output = doctor(write_sequence(lowered, tmp_path / "room"))
    assert code == 1
    assert output.startswith(f"{Mistake.VERTICAL}: ")
    assert "3.0 px higher in the left image" in output


@pytest.mark.slow
def test_nothing_is_found_in_a_good_recording(tmp_path: Path) -> None:
    code, output = doctor(write_sequence(room(), tmp_path / "room"))
    assert (code, output) == (
        0,
        "room: nothing wrong; images, poses and calibration fit each other",
    )
