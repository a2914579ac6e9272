"""The disk space of jobs and uploads: what has no room is refused; no result makes room for it."""

from vergence_proto.errors import QueueFull, Quota, UploadTooLarge
from vergence_service.access.principals import Principal
from vergence_service.jobs.job import Job
from vergence_service.jobs.kept_uploads import KeptUploads
from vergence_service.jobs.registry import JobRegistry
from vergence_service.jobs.storage import check_free, free_bytes
from vergence_service.jobs.store import JobStore
from vergence_service.process.threads import ThreadPool


class DiskRoom:
    """Compares what is needed with the limits of all jobs and of a principal, and with the disk.

    The limit of a principal is for those that have shown a credential. Where none is set, all jobs
    together may use the whole disk, and a principal half of what is free and of what they use.
    """

    def __init__(
        self,
        store: JobStore,
        jobs: JobRegistry,
        uploads: KeptUploads,
        *,
        disk_bytes: int | None,
        principal_bytes: int | None,
        background: ThreadPool,
    ) -> None:
        self._store = store
        self._jobs = jobs
        self._uploads = uploads
        self._disk_bytes = disk_bytes
        self._principal_bytes = principal_bytes
        self._background = background

    async def check_free(self, needed_bytes: int, *, what: str) -> None:
        """Raise InsufficientStorage unless the disk has room for ``needed_bytes`` more.

        What accepted jobs and announced uploads still need is not free.
        """
        missing = await self._background.run(self._uploads.missing_bytes)
        await self._background.run(
            check_free,
            self._store.directory,
            needed_bytes,
            promised_bytes=self._jobs.promised_bytes() + missing,
            what=what,
        )

    async def check_upload(self, length: int, owner: Principal) -> None:
        """Refuse an upload of ``length`` bytes that does not fit beside all that is kept.

        Raises UploadTooLarge if it can never fit, QueueFull if it does not fit now, Quota if its
        owner has too much, and InsufficientStorage if the disk has no room for it.
        """
        await self._check_limit(length, owner, what="the upload", upload="")
        await self.check_free(length, what="the upload")

    async def check_job(self, new: Job, owner: Principal, *, upload: str = "") -> None:
        """Refuse a job that does not fit beside all results that have not expired.

        Its input is on the disk already; ``upload`` is the id of the upload that it came in, which
        is deleted next. Raises UploadTooLarge if the job can never fit, QueueFull if it does not
        fit now, Quota if its owner has too much, and InsufficientStorage if the disk has no room
        for its result.
        """
        what = "the sequence and its result"
        await self._check_limit(new.disk_bytes, owner, what=what, upload=upload)
        await self.check_free(new.result_bytes, what="the result of the sequence")

    async def _check_limit(self, needed: int, owner: Principal, *, what: str, upload: str) -> None:
        limit = self._disk_bytes
        if limit is not None and needed > limit:
            raise UploadTooLarge(
                f"{what} need {needed} bytes, the server keeps {limit} for all "
                "sequences; send it in parts, or start the server with a larger batch.disk_mib"
            )
        await self._jobs.expire()
        if owner.proven:
            await self._check_principal(needed, owner, what=what, upload=upload)
        held = await self._background.run(self._uploads.held_bytes, upload)
        used = self._jobs.used_bytes() + held
        if limit is not None and used + needed > limit:
            raise QueueFull(
                f"sequences, their results and uploads use {used} of {limit} bytes on "
                f"disk, {what} need {needed}, and no result is deleted before it expires; fetch "
                "and delete results, or try again later (the server's settings batch.disk_mib, "
                "batch.keep_h)",
                retry_after_s=self._jobs.room_in_s(),
            )

    async def _room(self) -> int:
        """Return the space for all jobs and uploads together, used or free."""
        if self._disk_bytes is not None:
            return self._disk_bytes
        free = await self._background.run(free_bytes, self._store.directory)
        held = await self._background.run(self._uploads.held_bytes, "")
        missing = await self._background.run(self._uploads.missing_bytes)
        written = self._jobs.used_bytes() - self._jobs.promised_bytes() + held - missing
        return free + written

    async def _check_principal(
        self, needed: int, owner: Principal, *, what: str, upload: str
    ) -> None:
        limit = self._principal_bytes
        if limit is None:
            limit = await self._room() // 2
        held = await self._background.run(self._uploads.held_bytes, upload, owner.name)
        used = self._jobs.used_bytes(owner=owner.name) + held
        if used + needed > limit:
            raise Quota(
                f"sequences, results and uploads of {owner.name} use {used} bytes on disk, {what} "
                f"need {needed}, and the limit of one principal is {limit}; fetch "
                "and delete results, or try again later (the server's setting "
                "limits.sequences_mib)",
                retry_after_s=self._jobs.room_in_s(),
            )
