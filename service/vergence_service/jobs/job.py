"""A job: one uploaded sequence, the options of its submission, and its state."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from vergence_proto.jobs import JobState, Output


@dataclass(frozen=True, slots=True, kw_only=True)
class JobOptions:
    """The options of a submission."""

    iterations: int = 0  # iterations of every step; 0: the server's defaults
    outputs: tuple[Output, ...] = (Output.DISPARITY,)
    metrics: bool = False  # compare with the ground truth, if the upload has any


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """One sequence and its state. The store keeps it as JSON with these names."""

    job_id: str
    source: str  # KIND:PATH of the sequence, below the folder ``input``
    frames: int
    source_fps: float | None
    created_s: float  # Unix time, which stays valid after a restart
    client: str = ""  # address of the client that submitted it
    options: JobOptions = field(default_factory=JobOptions)
    state: JobState = JobState.QUEUED
    attempts: int = 0  # runs that began at frame ``reached`` and were not finished
    reached: int = 0  # frames that were done when the last run began
    finished_s: float | None = None  # Unix time of its end
    finished_up_s: float | None = None  # the same, in seconds of the store's uptime
    fps: float | None = None
    disk_bytes: int = 0  # space reserved until the job ends, then space used
    result_bytes: int = 0  # the share of it that its result needs
    accuracy: Mapping[str, float] | None = None
    frames_unread: int = 0  # frames without a result, because an image could not be read
    notes: tuple[str, ...] = ()  # what is missing in the upload or does not fit
    reason: str | None = None  # ErrorCode of the failure, or of what it waits for
    message: str | None = None

    @property
    def ended(self) -> bool:
        return self.state.ended


def job_to_json(job: Job) -> str:
    document = {each.name: getattr(job, each.name) for each in fields(job)}
    options = {each.name: getattr(job.options, each.name) for each in fields(job.options)}
    return json.dumps({**document, "options": options})


def job_from_json(document: str) -> Job:
    values: dict[str, Any] = json.loads(document)  # as job_to_json wrote it
    options = values.pop("options")
    outputs = tuple(map(Output, options.pop("outputs")))
    state = JobState(values.pop("state"))
    notes = tuple(values.pop("notes", ()))  # jobs of older servers have none
    return Job(**values, notes=notes, state=state, options=JobOptions(**options, outputs=outputs))
