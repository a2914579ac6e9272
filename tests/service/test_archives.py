"""Archives of other systems unpack to the files that they hold."""

import io
import os
import tarfile
from pathlib import Path

import pytest

from tests.support.http import ZIP, ended, files_below, http_server, submit
from tests.support.models import RecallModel
from tests.support.sequences import make_frames, sequence_files, tar_bytes, zip_bytes
from vergence_proto.errors import BadSequence, UploadTooLarge
from vergence_service.jobs.archive_limits import ArchiveLimits
from vergence_service.jobs.archives import ArchiveUnpacker, unpacking

LIMITS = ArchiveLimits(max_files=100, max_unpacked_bytes=2 << 20, max_ratio=100.0)
FILES = dict(sequence_files(make_frames(2)))
APPLE_DOUBLE = b"\0\5\26\7"


def unpacked(archive: bytes, tmp_path: Path) -> list[str]:
    (tmp_path / "archive").write_bytes(archive)
    folder = tmp_path / "folder"
    folder.mkdir()
    for _ in unpacking(tmp_path / "archive", folder, LIMITS):
        pass
    return files_below(folder)


@pytest.mark.skipif(os.name == "nt", reason="Windows cannot store these names")
def test_names_that_the_system_can_store_are_stored(tmp_path: Path) -> None:
    names = ["room/12:30.txt", 'room/"a" <b>?*|.txt', "räume/左.txt", "a b/c ..", "mixed/a\\b.txt"]
    assert unpacked(zip_bytes((name, b"x") for name in names), tmp_path) == sorted(names)


def test_backslashes_separate_where_nothing_else_does(tmp_path: Path) -> None:
    names = ["room\\", "room\\calib.json", "room\\left\\0.png", "note.txt"]
    archive = zip_bytes((name, b"" if name.endswith("\\") else b"x") for name in names)
    assert unpacked(archive, tmp_path) == ["note.txt", "room/calib.json", "room/left/0.png"]


@pytest.mark.parametrize("pack", [zip_bytes, tar_bytes], ids=["zip", "tar.gz"])
def test_companions_of_macos_are_passed_over(pack: object, tmp_path: Path) -> None:
    names = ["room/a.png", "room/._a.png", "room/.DS_Store", "__MACOSX/room/._a.png", "._room"]
    assert callable(pack)
    archive = pack([(f"./{name}", APPLE_DOUBLE) for name in names])
    assert unpacked(archive, tmp_path) == ["room/a.png"]


def test_names_of_another_encoding_do_not_matter_to_the_others(tmp_path: Path) -> None:
    archive = io.BytesIO()
    with tarfile.open(
        fileobj=archive, mode="w", format=tarfile.USTAR_FORMAT, encoding="latin-1"
    ) as file:
        for name in ("tür.txt", "a.png"):
            file.addfile(tarfile.TarInfo(name), io.BytesIO())
    assert unpacked(archive.getvalue(), tmp_path) == ["a.png", "t\ufffdr.txt"]


@pytest.mark.parametrize(
    "named",
    [
        lambda name: f"room\\{name}",
        lambda name: f"12:30:00/{name}",
        lambda name: name.replace(".png", ".PNG"),
    ],
    ids=["backslashes", "colons", "capitals"],
)
async def test_a_sequence_of_such_names_is_run(named: object) -> None:
    assert callable(named)
    archive = zip_bytes((named(name), content) for name, content in FILES.items())
    async with http_server(RecallModel()) as client:
        job = await ended(client, (await submit(client, archive))["id"])
    assert (job["state"], job["frames"]) == ("done", 2)


async def test_a_calibration_may_start_with_a_byte_order_mark(tmp_path: Path) -> None:
    marked = {**FILES, "calib.json": b"\xef\xbb\xbf" + FILES["calib.json"]}
    async with http_server(RecallModel()) as client:
        answer = await client.post("/v1/sequences", content=zip_bytes(marked.items()), headers=ZIP)
    assert answer.status_code == 202


def tar_of(mode: str, form: int) -> tuple[bytes, dict[str, bytes]]:
    """A tar with names and sizes that need headers of their own."""
    long = "a" * 90
    files = {f"räume/{long}/{long}/{index}.png": os.urandom(700 * index) for index in range(4)}
    archive = io.BytesIO()
    with tarfile.open(fileobj=archive, mode=mode, format=form) as file:  # type: ignore[call-overload] # a mode
        folder = tarfile.TarInfo("räume")
        folder.type = tarfile.DIRTYPE
        file.addfile(folder)
        for name, content in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            info.pax_headers = {"comment": "x" * 600}
            file.addfile(info, io.BytesIO(content))
    return archive.getvalue(), files


@pytest.mark.parametrize("at_once", [1, 511, 1 << 20])
@pytest.mark.parametrize("form", [tarfile.GNU_FORMAT, tarfile.PAX_FORMAT], ids=["gnu", "pax"])
@pytest.mark.parametrize("mode", ["w", "w:gz", "w:bz2", "w:xz"])
def test_a_tar_is_unpacked_while_it_arrives(
    mode: str, form: int, at_once: int, tmp_path: Path
) -> None:
    archive, files = tar_of(mode, form)
    half = len(archive) // 2
    unpacker = ArchiveUnpacker(tmp_path, tmp_path / "archive", LIMITS)
    for at in range(0, half, at_once):
        unpacker.feed(archive[at : min(at + at_once, half)])
    if mode == "w":
        assert any(path.is_file() for path in tmp_path.rglob("*.png"))
    for at in range(half, len(archive), at_once):
        unpacker.feed(archive[at : at + at_once])
    list(unpacker.finishing())
    unpacker.close()
    assert not (tmp_path / "archive").exists()
    found = {str(path.relative_to(tmp_path)): path for path in tmp_path.rglob("*.png")}
    assert {name: path.read_bytes() for name, path in found.items()} == files


@pytest.mark.parametrize("share", [0.02, 0.5, 0.9])
def test_a_tar_that_is_cut_short_is_refused(share: float, tmp_path: Path) -> None:
    archive, _ = tar_of("w", tarfile.PAX_FORMAT)
    unpacker = ArchiveUnpacker(tmp_path, tmp_path / "archive", LIMITS)
    unpacker.feed(archive[: round(share * (len(archive) - 10240))])
    with pytest.raises(BadSequence, match="cut short"):
        list(unpacker.finishing())
    unpacker.close()


def test_a_zip_shrinks_while_it_is_unpacked(tmp_path: Path) -> None:
    files = {f"{index}.png": os.urandom(200_000) for index in range(5)}
    scratch = tmp_path / "archive"
    target = tmp_path / "target"
    target.mkdir()
    unpacker = ArchiveUnpacker(target, scratch, LIMITS)
    unpacker.feed(zip_bytes(files.items()))
    used = []
    for _ in unpacker.finishing():
        unpacked_bytes = sum(path.stat().st_size for path in target.iterdir())
        used.append(scratch.stat().st_size + unpacked_bytes)
    assert max(used) < 1_250_000  # the archive, and one file that is written
    assert not scratch.exists()
    assert {path.name: path.read_bytes() for path in target.iterdir()} == files


@pytest.mark.parametrize(
    ("limits", "setting"),
    [
        ({"max_files": 1}, "batch.max_files"),
        ({"max_unpacked_bytes": 10}, "batch.max_unpacked_mib"),
        ({"max_ratio": 0.1}, "batch.max_ratio"),
    ],
)
def test_a_limit_names_its_setting(limits: dict[str, float], setting: str, tmp_path: Path) -> None:
    (tmp_path / "archive").write_bytes(zip_bytes(FILES.items()))
    (tmp_path / "folder").mkdir()
    small = ArchiveLimits(**{**_fields(LIMITS), **limits})  # type: ignore[arg-type]
    with pytest.raises(UploadTooLarge, match=setting.replace(".", r"\.")):
        list(unpacking(tmp_path / "archive", tmp_path / "folder", small))


def _fields(limits: ArchiveLimits) -> dict[str, float]:
    return {name: getattr(limits, name) for name in ArchiveLimits.__dataclass_fields__}
