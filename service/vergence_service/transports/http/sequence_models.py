"""The queries and answers of /v1/sequences."""

from dataclasses import replace
from datetime import UTC, datetime
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, JsonValue

from vergence_proto.errors import ErrorCode
from vergence_proto.jobs import (
    JobOutput,
    JobPriority,
    JobState,
    OnError,
    Quality,
    ResultFormat,
    WarningKind,
)
from vergence_service.jobs.job import JobOptions
from vergence_service.jobs.progress import JobStatus
from vergence_service.transports.http.pages import LABEL

_EXAMPLE: dict[str, JsonValue] = {
    "id": "5f0c9a7be21d4433",
    "state": "running",
    "created": "2026-01-31T12:00:00Z",
    "source": "vergence:room",
    "frames": 300,
    "frames_done": 120,
    "ahead": 0,
    "fps": 31.5,
    "eta_s": 5.7,
    "expires": None,
    "name": "drive 17",
    "labels": {"robot": "r2"},
    "output": ["disparity"],
    "on_error": "skip",
    "iterations": 0,
    "quality": "fast",
    "priority": "normal",
    "input": "",
    "keep_input": False,
    "webhook": "",
    "webhook_result": None,
    "metrics": False,
    "accuracy": None,
    "frames_failed": 0,
    "cold_frames": 0,
    "result_bytes": 0,
    "warnings": [],
    "notes": [],
    "reason": None,
    "message": None,
}


class OptionsQuery(BaseModel):
    """The options of a job."""

    model_config = ConfigDict(extra="forbid")

    iterations: int = Field(
        default=0, ge=0, le=64, description="iterations of a single pair; 0: the default"
    )
    quality: Quality = Field(
        default=Quality.FAST,
        description="steady: a pass backward too, for less flicker at twice the time; best: and a "
        "closer look at every frame, for fewer errors at six times the time",
    )
    output: list[JobOutput] = Field(
        default=[JobOutput.DISPARITY],
        description="what to keep of every frame; nerfstudio, colmap and tum need `left`",
    )
    on_error: OnError = Field(
        default=OnError.SKIP, description="what a frame does that cannot be read or stepped"
    )
    metrics: bool = Field(default=False, description="compare with the ground truth in the archive")
    name: str = Field(default="", max_length=200, description="your name for the job")
    label: list[Annotated[str, Field(pattern=LABEL)]] = Field(
        default=[], max_length=16, description="your labels for the job, KEY:VALUE"
    )
    priority: JobPriority = Field(
        default=JobPriority.NORMAL, description="which of the waiting jobs is next"
    )
    keep_input: bool = Field(
        default=False, description="keep the upload as long as the result, for `rerun`"
    )

    webhook: str = Field(
        default="",
        max_length=2000,
        description="https address that gets a signed message when the job ends",
    )

    @property
    def labels(self) -> dict[str, str]:
        """The labels by their key."""
        return dict(label.split(":", 1) for label in self.label)

    def options(self, before: JobOptions | None = None) -> JobOptions:
        """Return the options of the job; those not stated are as in ``before``."""
        stated: dict[str, Any] = {
            "iterations": self.iterations,
            "quality": self.quality,
            "outputs": _kept(self.output),
            "metrics": self.metrics,
            "on_error": self.on_error,
        }
        if before is None:
            return JobOptions(**stated)
        named = {"outputs" if name == "output" else name for name in self.model_fields_set}
        return replace(before, **{name: stated[name] for name in named & stated.keys()})


class SubmitQuery(OptionsQuery):
    """The options of a submission."""

    source: str | None = Field(
        default=None,
        description="the sequence as KIND:PATH in the archive, for example vergence:room or "
        "kitti:sequences/00; needed if the archive contains several",
    )
    upload: str | None = Field(
        default=None,
        max_length=64,
        description="id of a complete upload of /v1/uploads, in place of a body",
    )
    input: str = Field(
        default="",
        max_length=1000,
        description="file:NAME/PATH, a folder that the server's operator has named, in place of a "
        "body",
    )
    model: str | None = Field(default=None, description="refuse unless the server runs this model")
    wait: bool = Field(default=False, description="answer with the result, when the job is done")
    format: ResultFormat = Field(
        default=ResultFormat.PNG16, description="format of the awaited result"
    )


def _kept(outputs: list[JobOutput]) -> tuple[JobOutput, ...]:
    """Return what a job keeps: points need the colours of the left image."""
    points = [JobOutput.LEFT] if JobOutput.POINTS in outputs else []
    return tuple(dict.fromkeys([*outputs, *points]))


class ResultQuery(BaseModel):
    model_config = ConfigDict(extra="forbid")

    format: ResultFormat = ResultFormat.PNG16


class SequenceWarning(BaseModel):
    kind: WarningKind
    message: str


class SequenceJob(BaseModel):
    """A sequence that was accepted."""

    model_config = ConfigDict(json_schema_extra={"example": _EXAMPLE})

    id: str
    state: JobState
    created: datetime
    source: str = Field(description="the sequence as KIND:PATH in the upload")
    frames: int
    frames_done: int
    ahead: int = Field(description="sequences that run before this one")
    fps: float | None
    eta_s: float | None = Field(
        description="seconds until it is done, the sequences before it included; null before the "
        "server has stepped any"
    )
    expires: datetime | None = Field(
        description="time until which its result is kept, at least; null before its end"
    )
    name: str
    labels: dict[str, str]
    output: list[JobOutput]
    on_error: OnError
    iterations: int
    quality: Quality
    priority: JobPriority
    input: str = Field(description="folder of the server, in place of an upload")
    keep_input: bool
    webhook: str
    webhook_result: str | None = Field(
        description="delivered, given up, or null while neither is known"
    )
    metrics: bool
    accuracy: dict[str, float] | None = Field(description="mean over the frames with ground truth")
    frames_failed: int = Field(
        description="frames without a map, because they could not be read or stepped"
    )
    cold_frames: int = Field(description="frames that started without a state")
    result_bytes: int = Field(description="size of the result on the server's disk")
    warnings: list[SequenceWarning] = Field(description="what to know before the maps are there")
    notes: list[str] = Field(description="what is missing in the upload or does not fit")
    reason: ErrorCode | None = Field(
        description="code of the failure, or of what the sequence waits for"
    )
    message: str | None

    @classmethod
    def of(cls, status: JobStatus) -> "SequenceJob":
        job = status.job
        return cls(
            id=job.job_id,
            state=job.state,
            created=datetime.fromtimestamp(job.created_s, UTC),
            source=job.source,
            frames=job.frames,
            frames_done=status.frames_done,
            ahead=status.ahead,
            fps=status.fps,
            eta_s=status.eta_s,
            expires=None
            if status.expires_s is None
            else datetime.fromtimestamp(status.expires_s, UTC),
            name=job.name,
            labels=dict(job.labels),
            output=list(job.options.outputs),
            on_error=job.options.on_error,
            iterations=job.options.iterations,
            quality=job.options.quality,
            priority=job.priority,
            input=job.input,
            keep_input=job.keep_input,
            webhook=job.webhook,
            webhook_result=job.webhook_result or None,
            metrics=job.options.metrics,
            accuracy=None if job.accuracy is None else dict(job.accuracy),
            frames_failed=job.frames_failed,
            cold_frames=job.cold_frames,
            result_bytes=job.result_bytes if job.ended else 0,
            warnings=[
                SequenceWarning(kind=each.kind, message=each.message) for each in job.warnings
            ],
            notes=list(job.notes),
            reason=None if job.reason is None else ErrorCode(job.reason),
            message=job.message,
        )
