"""Names that client and server share for jobs: whole sequences that are uploaded over HTTP."""

from enum import StrEnum


class JobState(StrEnum):
    """The state of a job, in the words of the HTTP API."""

    QUEUED = "queued"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"

    @property
    def ended(self) -> bool:
        """True once the job is finished, with or without success."""
        return self in (JobState.DONE, JobState.FAILED)


class Output(StrEnum):
    """One kind of map that a result holds for every frame."""

    DISPARITY = "disparity"
    DEPTH = "depth"
    CONFIDENCE = "confidence"
    SIGMA = "sigma"


class ResultFormat(StrEnum):
    """The file format of a job's result."""

    PNG16 = "png16"
    """16-bit PNG: disparity, depth and sigma times 256, 0 where there is no value (the KITTI
    convention); confidence as 8-bit PNG."""
    PFM = "pfm"
    """Portable float map, 32-bit floats."""
    NPZ = "npz"
    """One NumPy archive per frame."""
    MP4 = "mp4"
    """A video of coloured disparity, for viewing only."""
