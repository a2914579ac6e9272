"""Jobs that outlive the process: a folder of files, and one SQLite table that says what they are.

::

    DIRECTORY/jobs.sqlite3        a row a job; a job is accepted once its row is committed
    DIRECTORY/incoming/ID/        uploads that are not accepted yet; emptied at every start
    DIRECTORY/jobs/ID/input       what was uploaded, unpacked; removed when the job ends
    DIRECTORY/jobs/ID/checkpoint  progress, see :mod:`vergence_service.jobs.checkpoints`
    DIRECTORY/jobs/ID/result      see :mod:`vergence_service.jobs.results`
"""

import os
import secrets
import shutil
import sqlite3
import sys
import threading
from pathlib import Path
from typing import Self

from vergence_proto.jobs import JobState
from vergence_service.jobs.job import Job, job_from_json, job_to_json


class StoreUnavailable(OSError):
    """The folder of the jobs cannot be used, or another server uses it."""


# Columns that queries and people need; what the rest of a job says is in one JSON document.
_TABLE = """
CREATE TABLE IF NOT EXISTS jobs (
    job_id TEXT PRIMARY KEY,
    state TEXT NOT NULL,
    created_s REAL NOT NULL,
    document TEXT NOT NULL
) STRICT
"""


class JobStore:
    """All methods block; call them from one thread at a time each, from any.

    Raises StoreUnavailable on entering: the folder cannot be written, or is another server's.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._turn = threading.Lock()

    def __enter__(self) -> Self:
        try:
            for name in ("incoming", "jobs"):
                (self._directory / name).mkdir(parents=True, exist_ok=True)
            self._database = sqlite3.connect(
                self._directory / "jobs.sqlite3",
                timeout=0,
                isolation_level=None,  # every statement is a transaction of its own
                check_same_thread=False,
            )
        except (OSError, sqlite3.Error) as error:
            raise StoreUnavailable(f"cannot keep jobs in {self._directory}: {error}") from None
        try:
            # Exclusive from the first access to the end of the process, however it ends: two
            # servers that ran the same jobs would write over each other.
            self._database.execute("PRAGMA locking_mode = EXCLUSIVE")
            self._database.execute("PRAGMA journal_mode = WAL")
            self._database.execute("PRAGMA synchronous = FULL")  # accepted survives a power cut
            self._database.execute(_TABLE)
            self._clear_leftovers()
        except sqlite3.Error as error:
            self._database.close()
            raise StoreUnavailable(
                f"cannot keep jobs in {self._directory}: {error}; if another server keeps its own "
                "there, give this one another folder with batch.directory"
            ) from None
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._database.close()

    def load(self) -> list[Job]:
        """Every job, oldest first."""
        with self._turn:
            rows = self._database.execute("SELECT document FROM jobs ORDER BY created_s").fetchall()
        return [job_from_json(document) for (document,) in rows]

    def new_folder(self) -> Path:
        """An empty folder for an upload; the next start removes it unless it is accepted."""
        folder = self._directory / "incoming" / secrets.token_hex(8)
        folder.mkdir()
        return folder

    def accept(self, folder: Path, job: Job) -> None:
        """Take an upload over; the job survives whatever happens to the process from here on."""
        _flush()
        folder.rename(self.folder(job.job_id))
        with self._turn:
            self._database.execute(
                "INSERT INTO jobs VALUES (?, ?, ?, ?)",
                (job.job_id, job.state, job.created_s, job_to_json(job)),
            )

    def update(self, job: Job) -> None:
        """Say how the job stands; of one that was deleted nothing comes back."""
        if job.ended:
            _flush()
        with self._turn:
            self._database.execute(
                "UPDATE jobs SET state = ?, document = ? WHERE job_id = ?",
                (job.state, job_to_json(job), job.job_id),
            )

    def delete(self, job_id: str) -> None:
        """The row first: a crash in between leaves files, which the next start removes."""
        with self._turn:
            self._database.execute("DELETE FROM jobs WHERE job_id = ?", (job_id,))
        remove_folder(self.folder(job_id))

    def folder(self, job_id: str) -> Path:
        return self._directory / "jobs" / job_id

    def tidy(self, job: Job) -> None:
        """Remove what a job that has ended does not need any more."""
        remove_folder(self.folder(job.job_id) / "input")
        (self.folder(job.job_id) / "checkpoint").unlink(missing_ok=True)
        if job.state is JobState.FAILED:
            remove_folder(self.folder(job.job_id) / "result")

    def _clear_leftovers(self) -> None:
        jobs = self.load()
        for job in jobs:
            if job.ended:
                self.tidy(job)
        known = {job.job_id for job in jobs}
        unfinished = (self._directory / "incoming").iterdir()
        orphans = (each for each in (self._directory / "jobs").iterdir() if each.name not in known)
        for folder in [*unfinished, *orphans]:
            remove_folder(folder)


def _flush() -> None:
    """All files to the disk at once, before the row that promises them."""
    if sys.platform != "win32":
        os.sync()


def remove_folder(folder: Path) -> None:
    """Whatever is left of it, if it is still there."""
    shutil.rmtree(folder, ignore_errors=True)


def folder_bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
