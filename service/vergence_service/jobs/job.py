"""What a job is: one uploaded sequence and what is to become of it."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from vergence_proto.jobs import JobState, Output


@dataclass(frozen=True, slots=True, kw_only=True)
class JobOptions:
    iterations: int = 0  # of every step; 0: the server's defaults
    outputs: tuple[Output, ...] = (Output.DISPARITY,)
    metrics: bool = False  # compare with the truth, where the upload has it


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """One sequence and what is to become of it."""

    job_id: str
    source: str  # KIND:PATH below input
    frames: int
    source_fps: float | None
    created_s: float  # Unix time, which outlives a restart
    client: str = ""  # the address that it came from
    options: JobOptions = field(default_factory=JobOptions)
    state: JobState = JobState.QUEUED
    attempts: int = 0  # that ended with the server
    finished_s: float | None = None
    fps: float | None = None
    disk_bytes: int = 0  # reserved for it until it ends, then what it takes
    accuracy: Mapping[str, float] | None = None
    reason: str | None = None  # of the failure, as ErrorCode
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
    return Job(**values, state=state, options=JobOptions(**options, outputs=outputs))
