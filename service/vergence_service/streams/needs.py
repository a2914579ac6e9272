"""What a stream needs, by the size of its images: checked before anything is made for it."""

from collections.abc import Iterable
from dataclasses import dataclass

from vergence_proto.errors import BadCalibration, FrameTooLarge
from vergence_proto.types import StereoRig
from vergence_service.inference.model import StereoModel, state_bytes
from vergence_service.process.memory import StreamMemory
from vergence_service.streams.search_window import SearchReach, SearchWindow

# Smaller images have nothing to match. The network would still see them as wide as its search.
_LEAST_SIDE = 16
# Two decoded images in RGB, disparity and sigma in float32, and both encoded.
_WORK_BYTES_A_PIXEL = 2 * 3 + 2 * 4 + 2 * 2
# For each camera, positions as two int16 and one uint16; and what the left one sees.
_MAP_BYTES_A_PIXEL = 2 * 6 + 1
# While a snapshot is written: the state that waits, the one that is written, and its bytes, twice.
_STATES_OF_SNAPSHOTS = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageSizes:
    """The sizes of images that are served."""

    max_pixels: int
    max_side: int  # for the memory of a step also grows with the width

    def check(self, rig: StereoRig) -> None:
        """Raise FrameTooLarge or BadCalibration if the images of a rig have another size."""
        width, height = rig.left.width, rig.left.height
        if width * height > self.max_pixels or max(width, height) > self.max_side:
            raise FrameTooLarge(
                f"expected at most {self.max_pixels} pixels per image and {self.max_side} per "
                f"side, got {width}x{height}; send smaller images, or start the server with a "
                "larger limits.max_pixels or limits.max_side_px"
            )
        if min(width, height) < _LEAST_SIDE:
            raise BadCalibration(
                f"expected images of at least {_LEAST_SIDE}x{_LEAST_SIDE} pixels, got "
                f"{width}x{height}"
            )


def stream_memory(
    rig: StereoRig,
    model: StereoModel,
    reach: SearchReach,
    *,
    warm_iterations: int,
    cold_iterations: int,
    snapshots: bool = False,
) -> StreamMemory:
    """Return the memory that a stream of this rig needs; ``snapshots``: if they are kept of it."""
    width, height = rig.left.width, rig.left.height
    rectified = rig.as_rectified()
    if rectified is None:  # then zero disparity is at offset 0, and nothing is moved
        reduction = reach.reduction(width)
        rows, columns = -(-height // reduction), -(-width // reduction)
    else:
        searched = SearchWindow.of(rectified, reach).rig
        rows, columns = searched.height, searched.width
    steps: Iterable[tuple[int, bool]] = ((warm_iterations, False), (cold_iterations, True))
    states = 1 + _STATES_OF_SNAPSHOTS * snapshots
    return StreamMemory(
        state=states * state_bytes(model.card, rows, columns),
        work=_WORK_BYTES_A_PIXEL * width * height,
        maps=0 if rectified else _MAP_BYTES_A_PIXEL * width * height,
        step=max(model.step_bytes(rows, columns, count, cold=cold) for count, cold in steps),
    )
