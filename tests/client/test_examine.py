"""``vergence doctor KIND:PATH`` names what a recording lacks."""

import io
from pathlib import Path

from rich.console import Console

from tests.support.textured_wall import write_wall
from vergence.cli.doctor import examine


def examined(folder: Path) -> tuple[bool, str]:
    printed = io.StringIO()
    fine = examine(f"vergence:{folder}", Console(file=printed, width=400))
    return fine, printed.getvalue()


def test_a_missing_image_is_named_and_the_others_are_examined(tmp_path: Path) -> None:
    folder = write_wall(tmp_path / "wall", frames=4)
    assert examined(folder)[0]
    (folder / "frame_0001_right.png").unlink()
    fine, printed = examined(folder)
    assert not fine
    assert f"{folder / 'frame_0001_right.png'}: not found" in printed
    assert "nothing else wrong" in printed
