"""Hostile uploads are refused with a reason, and no files remain."""

import bz2
import gzip
import io
import json
import lzma
import struct
import tarfile
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

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
from vergence_proto.errors import BadSequence, UploadTooLarge
from vergence_service.jobs.archive_limits import ArchiveLimits
from vergence_service.jobs.archives import unpacking
from vergence_service.jobs.decompression import Decompression

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


def without_data(png: bytes) -> bytes:
    """The picture with its data replaced by as many zeros; only a decoder sees that."""
    start = png.index(b"IDAT") + 4
    end = png.index(b"IEND") - 8
    return png[:start] + bytes(end - start) + png[end:]


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
    "pictures that are all damaged": Hostile(
        lambda: zip_bytes(
            (name, without_data(file) if name.endswith(".png") else file)
            for name, file in FILES.items()
        ),
        "BAD_SEQUENCE",
        says="frame_0000_left.png: the PNG",
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
            # By default, a damaged image only costs its own frame.
            query = f"{upload.query or '?'}&on_error=fail"
            answer = await client.post(
                f"/v1/sequences{query}", content=upload.body(), headers=dict(upload.headers)
            )
            refusal = (answer.status_code, reason_of(answer))
            assert refusal == (upload.status, upload.reason), (what, answer.text)
            assert upload.says in answer.text, (what, answer.text)
            assert str(tmp_path) not in answer.text, what
            assert not [*(tmp_path / "incoming").iterdir(), *(tmp_path / "jobs").iterdir()], what
        fine = await submit(client, zip_bytes(FILES.items()))
        assert (await ended(client, fine["id"]))["state"] == "done"


def packed_tar(*headers: bytes) -> bytes:
    packer = zlib.compressobj(wbits=31)
    return b"".join(map(packer.compress, headers)) + packer.compress(bytes(1024)) + packer.flush()


def folders(count: int) -> bytes:
    """A tar of so many folders, and nothing else."""
    info = tarfile.TarInfo("folder")
    info.type = tarfile.DIRTYPE
    return packed_tar(info.tobuf() * count)


def header_after_header(count: int) -> bytes:
    """Each extended header says that another one follows."""
    info = tarfile.TarInfo("pax")
    info.type, info.size = tarfile.XHDTYPE, 512
    return packed_tar(
        (info.tobuf(tarfile.USTAR_FORMAT) + b"20 comment=01234567\n".ljust(512)) * count
    )


def large_headers(count: int) -> bytes:
    info = tarfile.TarInfo("pax")
    info.type, info.size = tarfile.XGLTYPE, 1 << 19
    text = b"524288 comment=" + b"x" * ((1 << 19) - 16) + b"\n"
    return packed_tar(*[info.tobuf(tarfile.USTAR_FORMAT) + text] * count)


def directory_of(entries: int) -> bytes:
    """A zip whose directory has so many entries for the same few bytes."""
    one = zip_bytes([("a", b"")])
    start = one.index(b"PK\x01\x02")
    end = one.index(b"PK\x05\x06")
    directory = one[start:end] * entries
    tail = struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 1, 1, len(directory), start, 0)
    return one[:start] + directory + tail


def xz_with_dictionary(nbytes: int) -> bytes:
    filters = [{"id": lzma.FILTER_LZMA2, "preset": 0, "dict_size": nbytes}]
    return lzma.compress(bytes(2048), format=lzma.FORMAT_XZ, filters=filters)


@pytest.mark.parametrize(
    ("packed", "error", "says"),
    [
        pytest.param(lambda: folders(5000), UploadTooLarge, "200 files", id="folders"),
        pytest.param(
            lambda: header_after_header(2000), BadSequence, "headers of at most", id="recursion"
        ),
        pytest.param(lambda: large_headers(3), BadSequence, "headers of at most", id="headers"),
        pytest.param(
            lambda: directory_of(60_000), BadSequence, "headers of at most", id="directory"
        ),
        pytest.param(lambda: xz_with_dictionary(1 << 29), BadSequence, "limit", id="dictionary"),
    ],
)
def test_headers_of_an_archive_take_little_memory(
    packed: Callable[[], bytes], error: type[Exception], says: str, tmp_path: Path
) -> None:
    archive, target = tmp_path / "archive", tmp_path / "target"
    archive.write_bytes(packed())
    target.mkdir()
    limits = ArchiveLimits(max_files=200, max_unpacked_bytes=1 << 30, max_ratio=100)
    tracemalloc.start()
    try:
        with pytest.raises(error, match=says):
            list(unpacking(archive, target, limits))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 8 << 20


PACKERS: dict[str, Callable[[bytes], bytes]] = {
    "gzip": gzip.compress,
    "bzip2": bz2.compress,
    "xz": lzma.compress,
}


@pytest.mark.parametrize("pack", PACKERS.values(), ids=PACKERS)
@pytest.mark.parametrize("at_once", [1, 100, 1 << 20])
def test_a_file_of_several_streams_is_decompressed_as_it_comes(
    pack: Callable[[bytes], bytes], at_once: int
) -> None:
    content = bytes(range(256)) * 3000
    packed = pack(content[:1000]) + bytes(8) + pack(content[1000:]) + bytes(4)
    decompression = Decompression(packed[:6])

    def unpacked(data: bytes) -> bytes:
        pieces = [data[i : i + at_once] for i in range(0, len(data), at_once)]
        return b"".join(out for piece in pieces for out in decompression.pieces(piece))

    assert unpacked(packed) == content
    decompression.end()
    unpacked(packed[:500])
    with pytest.raises(EOFError, match="cut short"):
        decompression.end()
