"""The jobs on disk: a folder of files and one SQLite table. They survive the process.

::

    DIRECTORY/jobs.sqlite3        one row per job; a job is accepted when its row is committed
    DIRECTORY/webhook_secret      signs webhooks, see :mod:`vergence_service.jobs.webhooks`
    DIRECTORY/incoming/ID/        uploads that are not accepted yet; removed at every start
    DIRECTORY/jobs/ID/input       the unpacked upload; removed when the job ends, unless it is kept
    DIRECTORY/jobs/ID/passes      maps to be fused; removed when the job ends
    DIRECTORY/jobs/ID/checkpoint  progress, see :mod:`vergence_service.jobs.checkpoints`
    DIRECTORY/jobs/ID/archives    see :mod:`vergence_service.jobs.archive_index`
    DIRECTORY/jobs/ID/result      see :mod:`vergence_service.jobs.results`
"""

import secrets
import shutil
import sqlite3
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Self

from vergence_service.jobs.job import Job, job_from_json, job_to_json
from vergence_service.jobs.storage import flush_path


class StoreUnavailable(OSError):
    """The folder of the jobs cannot be used."""


class StoreInUse(StoreUnavailable):
    """Another server uses the folder of the jobs."""


# Columns for queries and for people. The JSON document contains the whole job.
_JOBS = """
CREATE TABLE IF NOT EXISTS jobs (
    job_id TEXT PRIMARY KEY,
    state TEXT NOT NULL,
    created_s REAL NOT NULL,
    document TEXT NOT NULL
) STRICT
"""
# One row: the time that all servers of this folder have run, together.
_UPTIME = "CREATE TABLE IF NOT EXISTS uptime (seconds REAL NOT NULL) STRICT"


class JobStore:
    """The jobs of one server on disk. All methods block; any thread may call them.

    Entering the context raises StoreInUse if another server uses the folder, and StoreUnavailable
    if it cannot be written.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._turn = threading.Lock()

    def __enter__(self) -> Self:
        try:
            for name in ("incoming", "jobs"):
                (self._directory / name).mkdir(parents=True, exist_ok=True)
            for folder in (self._directory, self._directory / "incoming", self._directory / "jobs"):
                with suppress(PermissionError):  # a volume of another owner
                    folder.chmod(0o700)  # uploads are pictures of homes
            self._database = sqlite3.connect(
                self._directory / "jobs.sqlite3",
                timeout=0,
                isolation_level=None,  # every statement is its own transaction
                check_same_thread=False,
            )
        except (OSError, sqlite3.Error) as error:
            raise StoreUnavailable(f"cannot keep jobs in {self._directory}: {error}") from None
        try:
            # The lock lasts from the first access to the end of the process, however it ends. Two
            # servers that ran the same jobs would overwrite each other's files.
            self._database.execute("PRAGMA locking_mode = EXCLUSIVE")
            self._database.execute("PRAGMA journal_mode = WAL")
            # An accepted job survives a power cut.
            self._database.execute("PRAGMA synchronous = FULL")
            self._database.execute(_JOBS)
            with suppress(PermissionError):
                (self._directory / "jobs.sqlite3").chmod(0o600)
            self._database.execute(_UPTIME)
            row = self._database.execute("SELECT seconds FROM uptime").fetchone()
            if row is None:
                self._database.execute("INSERT INTO uptime VALUES (0)")
            self._uptime_before_s = row[0] if row else 0.0
            self._opened_s = time.monotonic()
            self._clear_leftovers()
        except sqlite3.Error as error:
            self._database.close()
            if error.sqlite_errorcode == sqlite3.SQLITE_BUSY:
                raise StoreInUse(
                    f"cannot keep jobs in {self._directory}: another server uses this folder; "
                    "choose another one with batch.directory"
                ) from None
            raise StoreUnavailable(f"cannot keep jobs in {self._directory}: {error}") from None
        return self

    def __exit__(self, *exc_info: object) -> None:
        with suppress(sqlite3.Error):
            self.note_uptime()
        self._database.close()

    @property
    def directory(self) -> Path:
        """The folder of the jobs."""
        return self._directory

    def uptime_s(self) -> float:
        """Return the time that all servers of this folder have run, together.

        Unlike the wall clock, which may be set to any time while a server runs or is off, it only
        counts the time in which a result could be downloaded.
        """
        return self._uptime_before_s + time.monotonic() - self._opened_s

    def note_uptime(self) -> None:
        """Keep the uptime for the next server."""
        with self._turn:
            self._database.execute("UPDATE uptime SET seconds = ?", (self.uptime_s(),))

    def load(self) -> list[Job]:
        """Read all jobs, oldest first."""
        with self._turn:
            rows = self._database.execute("SELECT document FROM jobs ORDER BY rowid").fetchall()
        return [job_from_json(document) for (document,) in rows]

    def new_folder(self) -> Path:
        """Make an empty folder for an upload. The next start removes it unless it is accepted."""
        folder = self._directory / "incoming" / secrets.token_hex(8)
        folder.mkdir()
        return folder

    def insert(self, folder: Path, job: Job) -> None:
        """Add a job and move its upload to its folder. A crash after this does not lose it.

        The files of the upload must be flushed before.
        """
        folder.rename(self.folder(job.job_id))
        flush_path(self._directory / "jobs")
        with self._turn:
            self._database.execute(
                "INSERT INTO jobs VALUES (?, ?, ?, ?)",
                (job.job_id, job.state, job.created_s, job_to_json(job)),
            )

    def update(self, job: Job) -> None:
        """Replace the row of a job, unless it was deleted.

        If the job has ended, its result must be flushed before.
        """
        with self._turn:
            self._database.execute(
                "UPDATE jobs SET state = ?, document = ? WHERE job_id = ?",
                (job.state, job_to_json(job), job.job_id),
            )

    def delete(self, job_id: str) -> None:
        """Delete the row, then the files. After a crash in between, the next start removes them."""
        with self._turn:
            self._database.execute("DELETE FROM jobs WHERE job_id = ?", (job_id,))
        remove_folder(self.folder(job_id))

    def folder(self, job_id: str) -> Path:
        """Return the folder of a job."""
        return self._directory / "jobs" / job_id

    def tidy(self, job: Job) -> None:
        """Remove the files that an ended job does not need; the next start tries again."""
        for name in ("passes",) if job.keep_input else ("input", "passes"):
            remove_folder(self.folder(job.job_id) / name)
        with suppress(OSError):
            (self.folder(job.job_id) / "checkpoint").unlink(missing_ok=True)

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


def remove_folder(folder: Path) -> None:
    """Remove a folder with its content, or a link to one, if it exists."""
    if folder.is_symlink():
        folder.unlink(missing_ok=True)
        return
    shutil.rmtree(folder, ignore_errors=True)


def folder_bytes(folder: Path) -> int:
    """Return the size of all files in a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
