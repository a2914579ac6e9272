"""Names that client and server share for jobs: whole sequences that are uploaded over HTTP."""

from enum import StrEnum


class JobState(StrEnum):
    """The state of a job, in the words of the HTTP API."""

    QUEUED = "queued"
    """It waits for its turn, or for what its message says."""
    RUNNING = "running"
    """Its frames are being stepped."""
    DONE = "done"
    """All frames were stepped or skipped."""
    FAILED = "failed"
    """It ended at a frame, and keeps those before."""
    CANCELLED = "cancelled"
    """It was stopped, and keeps the frames that were done."""

    @property
    def ended(self) -> bool:
        """True once the job is finished, with or without success."""
        return self in (JobState.DONE, JobState.FAILED, JobState.CANCELLED)


class JobPriority(StrEnum):
    """Which of the waiting jobs is next; a running one is not stopped."""

    LOW = "low"
    """After all others."""
    NORMAL = "normal"
    """Oldest first."""
    HIGH = "high"
    """Before all others."""


class Output(StrEnum):
    """One kind of map that a result holds for every frame."""

    DISPARITY = "disparity"
    DEPTH = "depth"
    CONFIDENCE = "confidence"
    SIGMA = "sigma"


class JobOutput(StrEnum):
    """What a job keeps of every frame. Depth and points are made of the disparity."""

    DISPARITY = "disparity"
    DEPTH = "depth"
    CONFIDENCE = "confidence"
    SIGMA = "sigma"
    LEFT = "left"
    """The rectified left image that the maps belong to."""
    POINTS = "points"
    """Points in the world, coloured by the left image, which is kept too."""


class Quality(StrEnum):
    """What a job does beyond one step a frame. Each price was measured beside ``fast``.

    Frames without poses gain nothing from more than ``fast``: each is a cold start already.
    """

    FAST = "fast"
    """One step a frame, each from the state of the frame before."""
    STEADY = "steady"
    """A second pass backward in time, fused with the first: less flicker, twice the time."""
    BEST = "best"
    """The same and a closer look at every frame by itself: fewest errors, six times the time."""


class OnError(StrEnum):
    """What a bad frame does to its job."""

    SKIP = "skip"
    """The frame has no map, its record says why, and the next frame continues."""
    FAIL = "fail"
    """The job ends there, and keeps the frames before."""


class WarningKind(StrEnum):
    """What a user should know of a job before he reads its maps."""

    NO_POSES = "no_poses"
    """No frame has a pose, so each one is a cold start."""
    COLD_FRAMES = "cold_frames"
    """Some frames start cold: their pose is missing, jumps, or time does."""
    GUESSED_UNITS = "guessed_units"
    """The calibration is not known, so depth is not in metres."""
    UNREADABLE = "unreadable"
    """Images are missing or damaged."""
    QUALITY = "quality"
    """The quality that was asked for changes nothing for this sequence or model."""
    DATA = "data"
    """What is missing in the upload or does not fit."""


class ResultFormat(StrEnum):
    """The file format of a job's result."""

    PNG16 = "png16"
    """16-bit PNG: disparity, depth and sigma times 256, 0 where there is no value (the KITTI
    convention); confidence as 8-bit PNG."""
    PNG16MM = "png16mm"
    """The same with depth in millimetres: 65.535 m at most, 0 where there is no value."""
    PFM = "pfm"
    """Portable float map, 32-bit floats."""
    NPZ = "npz"
    """One NumPy archive per frame."""
    NERFSTUDIO = "nerfstudio"
    """transforms.json with images and depth in millimetres."""
    COLMAP = "colmap"
    """A sparse model as text, images, and depth maps as float32."""
    TUM = "tum"
    """TUM RGB-D: depth in steps of 1/5000 m, and a trajectory with times."""
    KITTI = "kitti"
    """disp_0 of the stereo benchmark; poses and times of the odometry benchmark."""
    MIDDLEBURY = "middlebury"
    """Names and files of a MiddEval3 submission."""
    ETH3D = "eth3d"
    """Names and files of a two-view submission to ETH3D."""
    MP4 = "mp4"
    """A video of coloured disparity, for viewing only."""


MAP_FORMATS = (ResultFormat.PNG16, ResultFormat.PFM, ResultFormat.NPZ)
"""The formats of single maps, which ``vergence run`` writes too."""
