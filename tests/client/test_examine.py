"""``vergence doctor KIND:PATH`` names what a recording lacks."""

import io
from pathlib import Path

from rich.console import Console

from tests.support.textured_wall import write_wall
from vergence.cli.doctor import examine


def examined(folder: Path) -> tuple[bool, str]:
    told = io.StringIO()
    fine = examine(f"vergence:{folder}", Console(file=told, width=400))
    return fine, told.getvalue()


def test_a_missing_image_is_named_and_the_others_are_examined(tmp_path: Path) -> None:
    folder = write_wall(tmp_path / "wall", frames=4)
    assert examined(folder)[0]
    (folder / "frame_0001_right.png").unlink()
    fine, told = examined(folder)
    assert not fine
    assert f"{folder / 'frame_0001_right.png'}: not found" in told
    assert "nothing else wrong" in told
