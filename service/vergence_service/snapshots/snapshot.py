"""What another server needs to resume a stream, as one value."""

import dataclasses
import hashlib
import json
from dataclasses import dataclass

from vergence_proto.types import Intrinsics, Origin, StereoRig
from vergence_service.inference.model import RecurrentState
from vergence_service.inference.snapshots import BadSnapshot, state_from_bytes, state_to_bytes


@dataclass(frozen=True, slots=True, eq=False)
class StreamSnapshot:
    """A stream after ``last_frame_id``. Its key has the id and the owner."""

    last_frame_id: int
    weights_sha256: str  # weights that the state belongs to
    origin: Origin  # origin of the next step, if there is no state
    state: RecurrentState | None  # None: the next step is cold

    @property
    def nbytes(self) -> int:
        """The size of the state."""
        return 0 if self.state is None else self.state.nbytes

    def to_bytes(self) -> bytes:
        """Write a line of JSON, then the state."""
        about = {
            "last_frame_id": self.last_frame_id,
            "weights_sha256": self.weights_sha256,
            "origin": self.origin.name,
        }
        state = b"" if self.state is None else state_to_bytes(self.state)
        return json.dumps(about).encode() + b"\n" + state

    @classmethod
    def from_bytes(cls, data: bytes) -> "StreamSnapshot":
        """Read a snapshot. Raises BadSnapshot if the bytes are not one."""
        line, _, state = data.partition(b"\n")
        try:
            about = json.loads(line)
            return cls(
                last_frame_id=int(about["last_frame_id"]),
                weights_sha256=str(about["weights_sha256"]),
                origin=Origin[about["origin"]],
                state=state_from_bytes(state) if state else None,
            )
        except (KeyError, TypeError, ValueError) as error:
            raise BadSnapshot(f"expected a snapshot of a stream: {error}") from None


def digest_of_rig(rig: StereoRig) -> str:
    """Return a name that two rigs share only if all their numbers are equal."""

    def numbers(camera: Intrinsics) -> list[object]:
        return [repr(value) for value in dataclasses.astuple(camera)]

    pose = rig.left_from_right.matrix.tolist()
    text = json.dumps([numbers(rig.left), numbers(rig.right), pose])
    return hashlib.sha256(text.encode()).hexdigest()


def digest_of_token(resume_token: bytes) -> str:
    """Return what the store keeps of a resume token. The token cannot be made from it."""
    return hashlib.sha256(resume_token).hexdigest()
