"""The admission of sequences: limits, checks of the upload, and the end of a job on request."""

import dataclasses
import logging
import secrets
import time
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Self

from vergence_proto.errors import (
    BadSequence,
    BadShape,
    InsufficientStorage,
    QueueFull,
    Quota,
    SequenceNotDone,
)
from vergence_proto.jobs import JobOutput, JobPriority, OnError, Quality, WarningKind
from vergence_service.access.principals import LOCAL, Principal
from vergence_service.jobs.folder_inputs import FolderInputs
from vergence_service.jobs.forecast import forecast
from vergence_service.jobs.job import Job, JobOptions, JobWarning
from vergence_service.jobs.kept_uploads import KeptUploads
from vergence_service.jobs.passes import BLOCK, why_no_passes
from vergence_service.jobs.progress import JobStatus
from vergence_service.jobs.registry import JobRegistry
from vergence_service.jobs.results import read_records, result_bytes
from vergence_service.jobs.room import DiskRoom
from vergence_service.jobs.run import job_stream_config
from vergence_service.jobs.sources import check_readable, find_sequence, missing_images
from vergence_service.jobs.storage import linking
from vergence_service.jobs.store import JobStore, folder_bytes, remove_folder
from vergence_service.jobs.tally import tally_of
from vergence_service.jobs.upload_checks import checking_folder
from vergence_service.jobs.webhooks import WebhookHosts, WebhookSender
from vergence_service.jobs.worker import JobWorker
from vergence_service.process.threads import to_the_end
from vergence_service.streams.engine import DepthEngine

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class QueueLimits:
    """The limits of all jobs together."""

    waiting: int  # most unfinished jobs, the running ones included
    waiting_per_client: int | None  # most unfinished jobs of one address
    waiting_per_principal: int  # most of one principal that has shown a credential
    checkpoint_s: float  # seconds of work that a crash may cost
    keep_s: float  # time that ended jobs are kept
    disk_bytes: int | None  # disk space; None: follows the free space
    principal_bytes: int | None  # of one principal that has shown a credential; None: half of it
    webhook_hosts: Sequence[str] = ()  # hosts that webhooks may go to
    inputs: Sequence[str] = ()  # NAME=PATH of folders that jobs may read


@dataclass(frozen=True, slots=True, kw_only=True)
class JobOrder:
    """What a client asks for with its upload."""

    source: str | None = None  # KIND:PATH; needed if the upload contains several sequences
    options: JobOptions = field(default_factory=JobOptions)
    upload: str = ""  # id of the upload that it came in, if that arrived in parts
    priority: JobPriority = JobPriority.NORMAL
    input: str = ""  # file:NAME/PATH, in place of an upload
    keep_input: bool = False  # for another run
    webhook: str = ""  # address that hears of the end
    name: str = ""
    labels: Mapping[str, str] = field(default_factory=dict)
    key: str = ""  # so that a repeated submission is not accepted twice
    key_fingerprint: str = ""


class JobQueue:
    """Admits jobs and deletes them; ``jobs`` is for reading.

    Use it inside ``async with``. Jobs run after :meth:`start`. All methods belong to the event
    loop; threads touch the files and the database.
    """

    def __init__(self, engine: DepthEngine, store: JobStore, *, limits: QueueLimits) -> None:
        self.threads = engine.threads.background
        self.jobs = JobRegistry(
            store,
            keep_s=limits.keep_s,
            background=self.threads,
        )
        self.uploads = KeptUploads(store.directory / "uploads", keep_s=limits.keep_s)
        self.room = DiskRoom(
            store,
            self.jobs,
            self.uploads,
            disk_bytes=limits.disk_bytes,
            principal_bytes=limits.principal_bytes,
            background=self.threads,
        )
        self._engine = engine
        self._store = store
        self._limits = limits
        self._worker = JobWorker(
            engine, self.jobs, checkpoint_s=limits.checkpoint_s, uploads=self.uploads
        )
        self.inputs = FolderInputs(limits.inputs)
        self._webhook_hosts = WebhookHosts(limits.webhook_hosts)
        self._webhooks = WebhookSender(
            self.jobs,
            self._webhook_hosts,
            secret_file=store.directory / "webhook_secret",
            background=self.threads,
        )
        # Owner and client of the jobs that are being added.
        self._accepting: list[tuple[str, str]] = []

    async def __aenter__(self) -> Self:
        await self.jobs.load()
        await self.threads.run(self.uploads.expire)
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        await self.stop()

    def start(self) -> None:
        """Run the waiting jobs, those of earlier servers first."""
        self._worker.start()
        self._webhooks.start()

    async def stop(self) -> None:
        """Run no more jobs. The running one keeps its place and its progress."""
        await self._worker.stop()
        await self._webhooks.stop()

    async def names(self) -> list[str]:
        """Return the names by which other servers look for what is here; see :meth:`has`."""
        return [*self.jobs.names(), *await self.threads.run(self.uploads.ids)]

    async def has(self, name: str) -> bool:
        """Check for a job or an upload with this id, or a job that was submitted with this key."""
        return self.jobs.has(name) or await self.threads.run(self.uploads.has, name)

    async def check_webhook(self, webhook: str) -> None:
        """Raise BadShape unless messages may go to this address; empty: there are none."""
        if webhook:
            await self._webhook_hosts.target(webhook)

    @asynccontextmanager
    async def upload_folder(
        self, client: str, *, upload_bytes: int, owner: Principal = LOCAL
    ) -> AsyncIterator[Path]:
        """Provide a folder for an upload of ``upload_bytes``; 0 if the size is not known.

        The folder is removed at the end of the block, unless :meth:`accept` has taken it.
        ``client`` is the address that the upload comes from, ``owner`` its sender.

        Raises QueueFull, Quota and InsufficientStorage if :meth:`accept` would now. An upload takes
        a place in the queue only when it is complete: a slow one keeps nobody out.
        """
        self._check_room(client, owner)
        await self.room.check_free(upload_bytes, what="the upload")
        folder = await self.threads.run(self._store.new_folder)
        try:
            yield folder
        finally:
            await self.threads.run(remove_folder, folder)

    def _check_room(self, client: str, owner: Principal) -> None:
        limits = self._limits
        waiting = [(job.owner, job.client) for job in self.jobs.unfinished()] + self._accepting
        if len(waiting) >= limits.waiting:
            raise QueueFull(
                f"{limits.waiting} sequences are waiting, the limit of the queue; try again later "
                "(the server's setting batch.waiting)",
                retry_after_s=self.jobs.usual_job_s(),
            )
        theirs = sum(each == owner.name for each, _ in waiting)
        if owner.proven and theirs >= limits.waiting_per_principal:
            raise Quota(
                f"{theirs} sequences of {owner.name} are waiting, the limit of one principal; try "
                "again later (the server's setting limits.waiting_sequences)",
                retry_after_s=self.jobs.usual_job_s(),
            )
        theirs = sum(each == client for _, each in waiting)
        if limits.waiting_per_client is not None and theirs >= limits.waiting_per_client:
            raise Quota(
                f"{theirs} sequences of {client} are waiting, the limit per client; try again "
                "later (the server's setting batch.waiting_per_client)",
                retry_after_s=self.jobs.usual_job_s(),
            )

    async def accept(
        self,
        folder: Path,
        order: JobOrder,
        *,
        upload_sha256: str,
        client: str,
        owner: Principal = LOCAL,
    ) -> JobStatus:
        """Accept the sequence below ``folder``/input. A crash does not lose an accepted job.

        Raises BadSequence, BadCalibration or FrameTooLarge if the upload cannot be stepped;
        UploadTooLarge, QueueFull or InsufficientStorage if it does not fit on the disk; QueueFull,
        and Quota if the client has too many unfinished jobs or uses too much of the disk; and
        NotReady or Draining if the server accepts no work.
        """
        options, upload = order.options, folder / "input"
        checking = checking_folder(upload, max_pixels=self._engine.max_pixels)
        unreadable = [why async for why in self.threads.iterate(checking) if why is not None]
        if unreadable and options.on_error is OnError.FAIL:
            raise BadSequence(unreadable[0])
        chosen, sequence = await self.threads.run(find_sequence, upload, order.source)
        if options.iterations and not sequence.is_single_pair:
            raise BadShape(
                "iterations is for a single pair: the network was trained for steps of "
                "model.iterations, and more of them make a sequence slower and worse; "
                "leave it out, and use quality=steady or quality=best"
            )
        # Refuse now what could not be opened when the job runs.
        await self._engine.check_offline(job_stream_config(sequence, options))
        await self.threads.run(check_readable, sequence, upload)
        unreadable += await self.threads.run(missing_images, sequence, upload)
        if unreadable and options.on_error is OnError.FAIL:
            raise BadSequence(unreadable[0])
        found = await self.threads.run(
            forecast,
            sequence,
            upload,
            self._engine.continuity,
            unreadable,
            recurrent=self._engine.card.recurrent,
        )
        warnings = found.warnings
        if options.quality is not Quality.FAST and (
            why := why_no_passes(sequence, self._engine.card)
        ):
            text = f"quality={options.quality} changes nothing, since {why}"
            warnings = (JobWarning(WarningKind.QUALITY, text), *warnings)
        uploaded = await self.threads.run(folder_bytes, folder)
        result = result_bytes(sequence, options.outputs)
        if options.quality is not Quality.FAST:
            passes = dataclasses.replace(sequence, files=sequence.files[:BLOCK])
            uploaded += result_bytes(passes, [JobOutput.DISPARITY, JobOutput.SIGMA])
        job = Job(
            job_id=secrets.token_hex(16),  # without a credential, it is all that protects a job
            source=chosen,
            frames=len(sequence),
            source_fps=sequence.fps,
            created_s=time.time(),
            client=client,
            owner=owner.name,
            name=order.name,
            labels=order.labels,
            priority=order.priority,
            input=order.input,
            keep_input=order.keep_input,
            webhook=order.webhook,
            key=order.key,
            key_fingerprint=order.key_fingerprint,
            options=options,
            upload_sha256=upload_sha256,
            warnings=warnings,
            cold_expected=found.cold_frames,
            megapixels=sequence.rig.left.width * sequence.rig.left.height / 1e6,
            disk_bytes=uploaded + result,
            result_bytes=result,
        )
        self._check_room(client, owner)
        self._accepting.append((owner.name, client))
        try:
            await self._check_disk(job, owner, order.upload)
            await self.jobs.add(folder, job)
        finally:
            self._accepting.remove((owner.name, client))
        return self.jobs.status(job.job_id)

    async def _check_disk(self, job: Job, owner: Principal, upload: str) -> None:
        try:
            await self.room.check_job(job, owner, upload=upload)
        except (QueueFull, Quota, InsufficientStorage) as error:
            self._engine.metrics.sequences_refused.inc()
            log.warning("an upload of %s was refused: %s", job.client or "a client", error)
            raise

    async def cancel(self, job_id: str) -> JobStatus:
        """Stop a job and keep the frames that are done. Nothing happens if it has ended.

        Raises UnknownSequence.
        """
        if not self.jobs.get(job_id).ended:
            await to_the_end(self._cancel(self.jobs.cancel(job_id)))
        return self.jobs.status(job_id)

    async def _cancel(self, job: Job) -> None:
        await self._worker.cancel(job.job_id)
        result = self.jobs.folder(job.job_id) / "result"
        kept = await self.threads.run(lambda: tally_of(read_records(result)))
        ended = replace(job, reached=kept.frames, frames_failed=kept.failed, cold_frames=kept.cold)
        await self.jobs.finish(ended, on_kept=lambda: None)

    async def delete(self, job_id: str) -> None:
        """Stop a job if it has not ended, and delete all its files. Raises UnknownSequence."""
        self.jobs.hide(job_id)
        await to_the_end(self._delete(job_id))

    async def link_input(self, job_id: str, folder: Path) -> None:
        """Make ``folder``/input from the input that a job has kept.

        Raises UnknownSequence, and SequenceNotDone if it has kept none.
        """
        kept = self.jobs.folder(job_id) / "input"
        job = self.jobs.get(job_id)
        if not await self.threads.run(kept.is_dir):
            raise SequenceNotDone(
                f"sequence {job_id} has not kept its input; submit sequences that are to run again "
                "with keep_input=true"
            )
        with self.jobs.reading(job.job_id):
            if job.input:
                await self.threads.run((folder / "input").symlink_to, kept.readlink())
            else:
                await self.threads.finish(linking(kept, folder / "input"))

    async def _delete(self, job_id: str) -> None:
        await self._worker.cancel(job_id)
        await self.jobs.delete(job_id)
