"""What ``vergence batch`` sends: archives by any name, folders as they are."""

import io
import tarfile
from pathlib import Path

import pytest

from tests.support.sequences import make_frames, sequence_files, write_sequence
from vergence.cli.errors import CliError
from vergence.cli.uploads import find_uploads
from vergence.jobs.packing import Upload


@pytest.mark.parametrize(
    ("name", "result"),
    [
        ("room.zip", "room"),
        ("ROOM.ZIP", "ROOM"),
        ("room.Tar.GZ", "room"),
        ("2024.05.01.tgz", "2024.05.01"),
    ],
)
def test_an_archive_is_one_by_its_suffix_in_any_case(
    name: str, result: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_bytes(b"PK")
    (upload,) = find_uploads([tmp_path / name])
    assert (upload.name, upload.upload) == (result, Upload(tmp_path / name))


def test_other_files_are_no_uploads(tmp_path: Path) -> None:
    (tmp_path / "room.rar").write_bytes(b"Rar")
    with pytest.raises(CliError, match="expected a folder, or an archive"):
        find_uploads([tmp_path / "room.rar"])


def test_a_folder_is_packed_without_companions_and_with_what_links_lead_to(tmp_path: Path) -> None:
    room = write_sequence(tmp_path / "disk" / "room", make_frames(2))
    (room / ".DS_Store").write_bytes(b"x")
    (room / "._calib.json").write_bytes(b"x")
    house = tmp_path / "house"
    house.mkdir()
    (house / "room").symlink_to(room, target_is_directory=True)
    (upload,) = find_uploads([house])
    packed = b"".join(upload.upload.chunks_now())
    with tarfile.open(fileobj=io.BytesIO(packed)) as file:
        names = sorted(name.removeprefix("room/") for name in file.getnames())
    assert names == sorted(name for name, _ in sequence_files(make_frames(2)))
