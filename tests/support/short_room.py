"""The bundled sequence with only its first frames: what plays all of it takes less time."""

import re
from pathlib import Path

ROOM = Path(__file__).parents[2] / "client/vergence/sample/room"


def link_short_room(folder: Path, *, frames: int) -> Path:
    """Link the first ``frames`` of the bundled sequence, and its calibration, in ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    for file in ROOM.iterdir():
        number = re.match(r"frame_(\d+)_", file.name)
        if number is None or int(number[1]) < frames:
            (folder / file.name).symlink_to(file)
    return folder
