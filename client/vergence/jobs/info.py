"""A job as its server states it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

from vergence_proto.jobs import JobState


@dataclass(frozen=True, slots=True)
class JobInfo:
    """The state of a job at one moment."""

    id: str
    """The id of the job on its server."""
    state: JobState
    """Queued, running, done, failed or cancelled."""
    frames: int
    """The number of frames in the sequence."""
    frames_done: int
    """The number of frames that are done, those without a map included."""
    ahead: int
    """The number of jobs before this one."""
    fps: float | None
    """Frames per second of its run."""
    eta_s: float | None = None
    """Seconds until it is done, the jobs before it included."""
    name: str = ""
    """The name that it was submitted with."""
    labels: Mapping[str, str] = field(default_factory=dict)
    """The labels that it was submitted with."""
    accuracy: Mapping[str, float | None] | None = None
    """EPE and error rates, if they were requested and the sequence has ground truth."""
    frames_failed: int = 0
    """The number of frames without a map, because they could not be read or stepped."""
    cold_frames: int = 0
    """The number of frames that started without a state."""
    warnings: tuple[str, ...] = ()
    """What to know before the maps are there: no poses, unknown units, unreadable images."""
    notes: tuple[str, ...] = ()
    """What was missing in the upload or did not fit."""
    reason: str | None = None
    """The error code of a failed job, or of what it waits for."""
    message: str | None = None
    """The same in words."""
    expires: str | None = None
    """The time until which the server keeps the result, at least, as in ISO 8601."""

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        """Read what a server states; a newer one may state more."""
        return cls(
            **{
                name: values[name]
                for name in (
                    *("id", "frames", "frames_done", "ahead", "fps", "eta_s", "name", "labels"),
                    *("accuracy", "frames_failed", "cold_frames", "reason", "message", "expires"),
                )
                if name in values
            },
            state=JobState(values["state"]),
            warnings=tuple(each["message"] for each in values.get("warnings", ())),
            notes=tuple(values.get("notes", ())),
        )
