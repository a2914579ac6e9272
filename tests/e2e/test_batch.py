"""``vergence batch`` against a real server: many sequences up, their results down."""

import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from tests.e2e.test_commands import vergence
from tests.support.http import http_server
from tests.support.models import NOT_FINITE, RecallModel
from tests.support.sequences import make_frames, sequence_files, write_sequence, zip_bytes
from tests.support.server import running_server
from tests.support.textured_wall import write_wall
from tests.support.weights_copy import WEIGHTS
from vergence.cli.batch import batch
from vergence.cli.errors import CliError


async def run(
    paths: list[Path], server: str, out: Path, *, again: Sequence[str] = (), **query: Any
) -> dict[str, Any]:
    await batch(
        paths,
        server=server,
        out=out,
        form="npz",
        query=query,
        json=out / "batch.json",
        console=Console(file=io.StringIO()),
        again=again,
    )
    figures: dict[str, Any] = json.loads((out / "batch.json").read_text())
    return figures


async def test_folders_and_archives_come_back_as_disparity(tmp_path: Path) -> None:
    house = tmp_path / "house"
    for n, room in enumerate(("hall", "attic"), start=1):
        write_sequence(house / room, make_frames(4, brightness=30 * n))
    archive = tmp_path / "hall.zip"
    archive.write_bytes(zip_bytes(sequence_files(make_frames(4, brightness=30))))
    # With one place in the queue the others have to come back.
    async with running_server(RecallModel(), batch__waiting=1) as server:
        figures = await run([house, archive], server.http_address, tmp_path / "out", metrics=True)
    assert sorted(figures["results"]) == ["attic", "hall", "hall-2"]
    assert (figures["sequences"], figures["failed"], figures["frames"]) == (3, 0, 12)
    assert figures["results"]["hall"]["accuracy"] == figures["results"]["hall-2"]["accuracy"]
    for index in range(4):
        hall, again, attic = (
            np.load(tmp_path / "out" / name / f"{index:04d}.npz")["disparity"]
            for name in ("hall", "hall-2", "attic")
        )
        np.testing.assert_array_equal(hall, again)
        assert (hall != attic).any()


async def test_what_was_collected_takes_no_room_on_the_server(tmp_path: Path) -> None:
    room = write_sequence(tmp_path / "room", make_frames(2))
    jobs = tmp_path / "jobs"
    async with http_server(RecallModel(), batch__directory=jobs) as client:
        await run([room], str(client.base_url), tmp_path / "out")
        assert list((jobs / "jobs").iterdir()) == []


async def test_a_job_that_was_kept_runs_again_without_an_upload(tmp_path: Path) -> None:
    room = write_sequence(tmp_path / "room", make_frames(3))
    out = tmp_path / "out"
    async with http_server(RecallModel(), batch__directory=tmp_path / "jobs") as client:
        server = str(client.base_url)
        await run([room], server, out, keep_input=True, priority="low")
        kept = json.loads((out / "room" / "manifest.json").read_text())["id"]
        room.rename(tmp_path / "gone")
        await run([], server, out, again=[kept], keep_input=False)
        assert (await client.get(f"/v1/sequences/{kept}")).json()["state"] == "done"
    for index in range(3):
        first, second = (
            np.load(out / name / f"{index:04d}.npz")["disparity"] for name in ("room", kept)
        )
        np.testing.assert_array_equal(first, second)


async def test_one_failure_does_not_stop_the_others_and_is_reported(tmp_path: Path) -> None:
    dark = make_frames(3)
    dark[1].left[0, 0] = NOT_FINITE
    write_sequence(tmp_path / "dark", dark)
    write_sequence(tmp_path / "fine", make_frames(3))
    (tmp_path / "broken.zip").write_bytes(b"PK\3\4 and no more")
    paths = [tmp_path / name for name in ("dark", "broken.zip", "fine")]
    async with running_server(RecallModel()) as server:
        with pytest.raises(CliError, match="2 of 3 sequences failed"):
            await run(paths, server.http_address, tmp_path / "out", on_error="fail")
    figures = json.loads((tmp_path / "out" / "batch.json").read_text())
    errors = {name: each["error"] for name, each in figures["results"].items()}
    assert errors["dark"].startswith("NON_FINITE")
    assert errors["broken"].startswith("BAD_SEQUENCE")
    assert errors["fine"] is None


@pytest.mark.parametrize("name", ["nothing", "empty", "text.txt"])
async def test_what_holds_no_sequence_is_reported_before_anything_is_sent(
    tmp_path: Path, name: str
) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.txt").write_text("hello")
    with pytest.raises(CliError, match=name):
        await run([tmp_path / name], "127.0.0.1:1", tmp_path / "out")


def test_the_command_starts_a_server_of_its_own_and_writes_pictures(tmp_path: Path) -> None:
    wall = write_wall(tmp_path / "wall", frames=2)
    outputs = ("--output", "disparity", "--output", "depth", "--metrics")
    done = vergence(
        *("batch", wall, "--out", tmp_path / "out", *outputs),
        VERGENCE_MODEL__WEIGHTS=str(WEIGHTS),
        VERGENCE_MODEL__NAME="whole",  # loaded at once
    )
    assert done.returncode == 0, done.stderr
    assert "wall" in done.stdout
    for kind in ("disparity", "depth"):
        names = [path.name for path in sorted((tmp_path / "out" / "wall" / kind).iterdir())]
        assert names == ["0000.png", "0001.png"]
