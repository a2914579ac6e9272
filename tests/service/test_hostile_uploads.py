"""Hostile uploads are refused with a reason, and no files remain."""

import io
import json
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tests.support.http import ZIP, ended, http_server, reason_of, submit
from tests.support.models import RecallModel
from tests.support.sequences import (
    CALIBRATION,
    make_frames,
    sequence_files,
    tar_bytes,
    with_size,
    zip_bytes,
)

FILES = dict(sequence_files(make_frames(2)))
HUGE_PNG = with_size(FILES["frame_0000_left.png"], 32_000, 32_000)
ARRAY_BOMB = zip_bytes([("disp.npy", bytes(40 << 20))], compressed=True)


@dataclass(frozen=True)
class Hostile:
    body: Callable[[], bytes]
    reason: str
    status: int = 400
    headers: tuple[tuple[str, str], ...] = tuple(ZIP.items())
    query: str = ""
    says: str = ""


def with_file(name: str, content: bytes = b"x") -> bytes:
    return zip_bytes([*FILES.items(), (name, content)])


def zip_link() -> bytes:
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as file:
        link = zipfile.ZipInfo("room")
        link.external_attr = 0o120777 << 16
        file.writestr(link, "/etc")
    return archive.getvalue()


def tar_of(kind: bytes, target: str = "") -> bytes:
    archive = io.BytesIO()
    with tarfile.open(fileobj=archive, mode="w") as file:
        info = tarfile.TarInfo("room")
        info.type, info.linkname = kind, target
        file.addfile(info)
    return archive.getvalue()


def zip_that_lies(declared: int) -> bytes:
    """A megabyte of zeros that the archive says is ``declared`` bytes."""
    honest = zip_bytes([("zeros", bytes(1 << 20))], compressed=True)
    true, false = struct.pack("<I", 1 << 20), struct.pack("<I", declared)
    return honest.replace(true, false)


def encrypted_zip() -> bytes:
    plain = bytearray(zip_bytes([("secret", b"x")]))
    plain[6] |= 1  # of the file
    plain[plain.index(b"PK\x01\x02") + 8] |= 1  # of the directory
    return bytes(plain)


def tar_with_endless_header() -> bytes:
    """A pax header that says it is a gigabyte, compressed to nothing."""
    info = tarfile.TarInfo("pax")
    info.type, info.size = tarfile.XHDTYPE, 1 << 30
    packer = zlib.compressobj(wbits=31)
    return packer.compress(info.tobuf(tarfile.USTAR_FORMAT) + bytes(1 << 22)) + packer.flush()


def changed(**files: bytes) -> bytes:
    return zip_bytes({**FILES, **{f"{name}.json": file for name, file in files.items()}}.items())


HOSTILE = {
    "not an archive": Hostile(lambda: b"hello", "BAD_SEQUENCE"),
    "nothing": Hostile(lambda: b"", "BAD_SEQUENCE"),
    "html": Hostile(
        lambda: b"<html>",
        "BAD_SEQUENCE",
        headers=(("Content-Type", "text/html"),),
        says="text/html",
    ),
    "half a zip": Hostile(lambda: zip_bytes(FILES.items())[:-100], "BAD_SEQUENCE"),
    "half a tar.gz": Hostile(lambda: tar_bytes(FILES.items())[:-100], "BAD_SEQUENCE"),
    "an empty zip": Hostile(lambda: zip_bytes([]), "BAD_SEQUENCE", says="vergence"),
    "damaged inside": Hostile(
        lambda: zip_bytes(FILES.items()).replace(b"fps", b"fsp"), "BAD_SEQUENCE", says="CRC"
    ),
    "path up": Hostile(lambda: with_file("../../evil"), "BAD_SEQUENCE", says="below"),
    "path from the root": Hostile(lambda: with_file("/etc/evil"), "BAD_SEQUENCE", says="below"),
    "path up of Windows": Hostile(
        lambda: with_file("a\\..\\..\\evil"), "BAD_SEQUENCE", says="below"
    ),
    "path of a network": Hostile(lambda: with_file("\\\\evil\\x"), "BAD_SEQUENCE", says="below"),
    "path up among companions": Hostile(
        lambda: with_file("__MACOSX/../../evil"), "BAD_SEQUENCE", says="below"
    ),
    "tar path up": Hostile(
        lambda: tar_bytes([("a/../../evil", b"x")], "w"), "BAD_SEQUENCE", says="below"
    ),
    "twice the same name": Hostile(
        lambda: with_file("calib.json/calib.json"), "BAD_SEQUENCE", says="twice"
    ),
    "a name as long as a book": Hostile(lambda: with_file("n" * 600), "BAD_SEQUENCE"),
    "a part of a name too long": Hostile(lambda: with_file("n" * 300), "BAD_SEQUENCE"),
    "zip with a link": Hostile(zip_link, "BAD_SEQUENCE", says="link"),
    "tar with a link": Hostile(lambda: tar_of(tarfile.SYMTYPE, "/etc"), "BAD_SEQUENCE"),
    "tar with a hard link": Hostile(lambda: tar_of(tarfile.LNKTYPE, "/etc/passwd"), "BAD_SEQUENCE"),
    "tar with a device": Hostile(lambda: tar_of(tarfile.CHRTYPE), "BAD_SEQUENCE"),
    "with a password": Hostile(encrypted_zip, "BAD_SEQUENCE", says="password"),
    "bomb by its own word": Hostile(
        lambda: zip_bytes([("zeros", bytes(40 << 20))], compressed=True), "UPLOAD_TOO_LARGE", 413
    ),
    "bomb by ratio": Hostile(
        lambda: zip_bytes([("zeros", bytes(2 << 20))], compressed=True), "UPLOAD_TOO_LARGE", 413
    ),
    "bomb that lies": Hostile(lambda: zip_that_lies(10), "BAD_SEQUENCE"),
    "tar bomb": Hostile(lambda: tar_bytes([("zeros", bytes(2 << 20))]), "UPLOAD_TOO_LARGE", 413),
    "endless header": Hostile(tar_with_endless_header, "BAD_SEQUENCE", says="header"),
    "too many files": Hostile(
        lambda: zip_bytes((str(n), b"") for n in range(300)), "UPLOAD_TOO_LARGE", 413
    ),
    "too many bytes": Hostile(lambda: bytes(5 << 20), "UPLOAD_TOO_LARGE", 413),
    "two sequences": Hostile(
        lambda: zip_bytes(
            (f"{room}/{name}", file) for room in "ab" for name, file in FILES.items()
        ),
        "BAD_SEQUENCE",
        says="vergence:a, vergence:b",
    ),
    "a source that leads out": Hostile(
        lambda: zip_bytes(FILES.items()), "BAD_SEQUENCE", query="?source=vergence:../.."
    ),
    "a source of no kind": Hostile(
        lambda: zip_bytes(FILES.items()), "BAD_SEQUENCE", query="?source=room"
    ),
    "a million pixels squared": Hostile(
        lambda: changed(
            calib=json.dumps({**CALIBRATION, "width": 10**6, "height": 10**6}).encode()
        ),
        "FRAME_TOO_LARGE",
        413,
    ),
    "half a picture": Hostile(
        lambda: zip_bytes(
            {**FILES, "frame_0001_left.png": FILES["frame_0001_left.png"][:200]}.items()
        ),
        "BAD_SEQUENCE",
        says="frame_0001_left.png: the PNG of 200 bytes is cut short",
    ),
    "a picture of a billion pixels": Hostile(
        lambda: zip_bytes({**FILES, "frame_0001_right.png": HUGE_PNG}.items()),
        "FRAME_TOO_LARGE",
        413,
        says="frame_0001_right.png",
    ),
    "an endless array": Hostile(
        lambda: zip_bytes({**FILES, "frame_0001_gt.npz": ARRAY_BOMB}.items()),
        "FRAME_TOO_LARGE",
        413,
        says="frame_0001_gt.npz",
    ),
    "a kind of image that nobody needs": Hostile(
        lambda: zip_bytes({**FILES, "frame_0001_right.png": b"II*\0 and more"}.items()),
        "BAD_SEQUENCE",
        says="frame_0001_right.png: expected PNG",
    ),
    "no baseline": Hostile(
        lambda: changed(calib=json.dumps({**CALIBRATION, "baseline_m": 0}).encode()),
        "BAD_SEQUENCE",
        says="baseline",
    ),
    "another model": Hostile(
        lambda: zip_bytes(FILES.items()), "BAD_SHAPE", query="?model=full", says="recall"
    ),
    "an option misspelt": Hostile(
        lambda: zip_bytes(FILES.items()), "BAD_SHAPE", query="?iteration=3", says="iteration"
    ),
}


async def test_hostile_uploads_are_refused_and_leave_nothing_behind(tmp_path: Path) -> None:
    limits = {
        "batch__max_files": 200,
        "batch__max_upload_mib": 4,
        "batch__max_unpacked_mib": 32,
        "batch__directory": tmp_path,
    }
    async with http_server(RecallModel(), **limits) as client:
        for what, upload in HOSTILE.items():
            answer = await client.post(
                f"/v1/sequences{upload.query}", content=upload.body(), headers=dict(upload.headers)
            )
            refusal = (answer.status_code, reason_of(answer))
            assert refusal == (upload.status, upload.reason), (what, answer.text)
            assert upload.says in answer.text, (what, answer.text)
            assert str(tmp_path) not in answer.text, what
            assert not [*(tmp_path / "incoming").iterdir(), *(tmp_path / "jobs").iterdir()], what
        fine = await submit(client, zip_bytes(FILES.items()))
        assert (await ended(client, fine["id"]))["state"] == "done"
