"""A job: one uploaded sequence, the options of its submission, and its state."""

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from vergence_proto.jobs import JobOutput, JobPriority, JobState, OnError, Quality, WarningKind

RANKS = {JobPriority.HIGH: 0, JobPriority.NORMAL: 1, JobPriority.LOW: 2}


@dataclass(frozen=True, slots=True, kw_only=True)
class JobOptions:
    """The options of a submission."""

    iterations: int = 0  # iterations of a single pair; 0: the server's default
    outputs: tuple[JobOutput, ...] = (JobOutput.DISPARITY,)
    metrics: bool = False  # compare with the ground truth, if the upload has any
    on_error: OnError = OnError.SKIP  # what a bad frame does
    quality: Quality = Quality.FAST


@dataclass(frozen=True, slots=True)
class JobWarning:
    """What a user should know before the maps are there."""

    kind: WarningKind
    message: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """One sequence and its state. The store keeps it as JSON with these names."""

    job_id: str
    source: str  # KIND:PATH of the sequence, below the folder ``input``
    frames: int
    source_fps: float | None
    created_s: float  # Unix time, which stays valid after a restart
    client: str = ""  # address of the client that submitted it
    owner: str = ""  # principal that submitted it; empty: one of an older server
    name: str = ""  # the client's own name for it
    labels: Mapping[str, str] = field(default_factory=dict)  # the client's own
    priority: JobPriority = JobPriority.NORMAL
    input: str = ""  # file:NAME/PATH of a folder of the server, in place of an upload
    keep_input: bool = False  # until the result expires, for another run
    webhook: str = ""  # address that hears of the end
    webhook_result: str = ""  # empty: not sent yet
    key: str = ""  # the client's key of the submission, so that it is not accepted twice
    key_fingerprint: str = ""  # of the request with this key
    options: JobOptions = field(default_factory=JobOptions)
    upload_sha256: str = ""  # of the body of the request, or of the upload
    warnings: tuple[JobWarning, ...] = ()
    cold_expected: int = 1  # frames that will start without a state, by their poses and times
    megapixels: float = 0.3  # of a frame
    state: JobState = JobState.QUEUED
    attempts: int = 0  # runs that began at frame ``reached`` and were not finished
    reached: int = 0  # frames that were done when the last run began, or when the job ended
    started_s: float | None = None  # Unix time of its first run
    finished_s: float | None = None  # Unix time of its end
    finished_up_s: float | None = None  # the same, in seconds of the store's uptime
    fps: float | None = None
    disk_bytes: int = 0  # space reserved until the job ends, then space used
    result_bytes: int = 0  # the share of it that its result needs
    accuracy: Mapping[str, float] | None = None
    frames_failed: int = 0  # frames without a map: an image could not be read, or the step failed
    cold_frames: int = 0  # frames that started without a state
    notes: tuple[str, ...] = ()  # what is missing in the upload or does not fit
    reason: str | None = None  # code of the failure, or of what the job waits for
    message: str | None = None  # the same in words

    @property
    def ended(self) -> bool:
        return self.state.ended


def job_to_json(job: Job) -> str:
    document = {each.name: getattr(job, each.name) for each in fields(job)}
    document["options"] = dataclasses.asdict(job.options)
    document["warnings"] = [[each.kind, each.message] for each in job.warnings]
    return json.dumps(document)


def job_from_json(document: str) -> Job:
    values: dict[str, Any] = json.loads(document)  # as job_to_json wrote it
    known = {each.name for each in fields(Job)}
    values = {name: value for name, value in values.items() if name in known}
    options = {"on_error": OnError.SKIP, "quality": Quality.FAST, **values.pop("options")}
    warnings = values.pop("warnings", [])  # jobs of older servers have none
    return Job(
        **{
            **values,
            "notes": tuple(values.get("notes", ())),
            "state": JobState(values["state"]),
            "priority": JobPriority(values.get("priority", JobPriority.NORMAL)),
            "warnings": tuple(JobWarning(WarningKind(kind), text) for kind, text in warnings),
            "options": JobOptions(
                **{
                    **options,
                    "outputs": tuple(map(JobOutput, options["outputs"])),
                    "on_error": OnError(options["on_error"]),
                    "quality": Quality(options["quality"]),
                }
            ),
        }
    )
