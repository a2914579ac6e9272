"""InStereo2K: ``instereo2k:ROOT/train/part1/000000``, a pair.

::

    left.png right.png        1080x860, rectified
    left_disp.png             16 bits, disparity x100; 0 unknown

No calibration is published, so the rig is nominal.
"""

from functools import partial
from pathlib import Path

from vergence_proto.datasets.files import existing
from vergence_proto.datasets.listing import found, image_beside
from vergence_proto.datasets.packings import nominal_rig, read_scaled, size_of
from vergence_proto.datasets.source import FrameFiles, StereoSource, Truth

_STEPS_PER_PX = 100.0


def find(root: Path) -> list[Path]:
    """List every pair in or under ``root``; by its truth, for left.png alone says too little."""
    return [
        path.parent
        for path in found(root, "left_disp.png")
        if all(_image(path.parent, side).is_file() for side in ("left", "right"))
    ]


def open_path(path: Path) -> StereoSource:
    """Open one pair.

    Raises DatasetError: a file is missing or wrong.
    """
    left = existing(_image(path, "left"), "the left image of a pair")
    truth = path / "left_disp.png"
    pair = FrameFiles(
        left,
        existing(_image(path, "right"), "the right image of a pair"),
        capture_ns=0,
        read_truth=partial(_truth, truth) if truth.is_file() else None,
    )
    return StereoSource(path.name, nominal_rig(left, size_of(left)), None, [pair], metric=False)


def _image(path: Path, side: str) -> Path:
    return image_beside(Path("any.png"), path, side)


def _truth(path: Path) -> Truth:
    return Truth(read_scaled(path, _STEPS_PER_PX))
