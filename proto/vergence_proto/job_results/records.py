"""What is known of each frame of a job besides its maps: one line of ``frames.jsonl``."""

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from vergence_proto.errors import BadSequence
from vergence_proto.geometry import Pose

_POSE_SHAPE = (3, 4)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameRecord:
    """One frame of a job: its input, and how its map was made or why there is none."""

    index: int
    """The position in the sequence, from 0."""
    left: str
    """Name of the left image, below the folder of the upload."""
    right: str
    """Name of the right image."""
    capture_ns: int
    """Time of mid-exposure in nanoseconds, as the upload states it."""
    error: str | None = None
    """The reason why the frame has no map; None: it has one."""
    note: str | None = None
    """What else is wrong with the frame, for example its ground truth."""
    world_from_left: Pose | None = None
    """Pose of the rectified left camera: OpenCV axes, metres; None if it is not known."""
    origin: str | None = None
    """The reason why the state was new; "warm" if it was not."""
    iterations: int = 0
    """Refinement iterations of the step."""
    step_count: int = 0
    """Steps since the state was new, this one included."""
    valid_share: float | None = None
    """Share of pixels with a value, 0 to 1."""
    mean_sigma_px: float | None = None
    """Mean expected absolute error of the pixels with a value, in pixels."""
    accuracy: Mapping[str, float | None] | None = None
    """Errors against the ground truth, if the job was asked for them."""

    def to_json(self) -> str:
        """Return the record as one line of JSON, without a line end."""
        values = {each.name: getattr(self, each.name) for each in dataclasses.fields(self)}
        if self.world_from_left is not None:
            values["world_from_left"] = self.world_from_left.matrix[:3].tolist()
        return json.dumps(values, allow_nan=False)

    @classmethod
    def from_json(cls, line: str | bytes) -> Self:
        """Read a line; other fields are ignored. Raises BadSequence: it is no record."""
        try:
            return cls.from_values(json.loads(line))
        except ValueError:
            raise BadSequence(f"expected a line of frames.jsonl, got {line[:80]!r}") from None

    @classmethod
    def from_values(cls, values: Mapping[str, Any]) -> Self:
        """Read a record of parsed JSON. Raises BadSequence: a field is missing or wrong."""
        try:
            known = {each.name: values[each.name] for each in dataclasses.fields(cls)}
            matrix = known["world_from_left"]
            if matrix is not None:
                rows = np.asarray(matrix, np.float64).reshape(_POSE_SHAPE)
                known["world_from_left"] = Pose(rows[:, :3], rows[:, 3])
            return cls(**known)
        except (KeyError, TypeError, ValueError) as error:
            raise BadSequence(f"expected a record of a frame: {error!r}") from None
