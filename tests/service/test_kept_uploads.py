"""Uploads on disk: those that are made at once do not delete each other."""

import os
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from vergence_service.access.principals import LOCAL
from vergence_service.jobs.kept_uploads import KeptUploads


def test_uploads_that_are_made_at_once_do_not_expire_each_other(tmp_path: Path) -> None:
    uploads = KeptUploads(tmp_path / "uploads", keep_s=60)
    with ThreadPoolExecutor(8) as threads:
        made = list(threads.map(lambda length: uploads.create(LOCAL, length), range(300)))
    found = [uploads.get(each.upload_id, LOCAL).length for each in made]
    assert found == list(range(300))


def test_what_a_crash_left_half_made_expires(tmp_path: Path) -> None:
    uploads = KeptUploads(tmp_path, keep_s=60)
    half = tmp_path / ".half"
    half.mkdir()
    uploads.expire()
    assert half.exists()
    os.utime(half, (time.time() - 61,) * 2)
    uploads.expire()
    assert not half.exists()
