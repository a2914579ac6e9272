"""IRS, one scene: ``irs:ROOT/Home/ArchVizInterior03Data``.

::

    l_1.png r_1.png       left and right, 960x540
    d_1.exr               disparity, one channel

The focal length is 480 px and the baseline 0.1 m. No times and no poses are published.
"""

from functools import partial
from pathlib import Path

from vergence_proto.datasets.exr import read_exr
from vergence_proto.datasets.files import DatasetError
from vergence_proto.datasets.listing import found, image_beside, images
from vergence_proto.datasets.packings import known_offsets, nominal_rig, size_of
from vergence_proto.datasets.source import (
    FrameFiles,
    StereoSource,
    Truth,
    nominal_ns,
    rectified_rig,
)

_OWN_SIZE = (960, 540)
_OWN_FX = 480.0
_BASELINE_M = 0.1


def find(root: Path) -> list[Path]:
    """List every scene in or under ``root``."""
    folders = sorted({path.parent for path in found(root, "l_*.*")})
    return [each for each in folders if images(each, r"l_\d+") and images(each, r"r_\d+")]


def open_path(path: Path) -> StereoSource:
    """Open one scene.

    Raises DatasetError: a file is missing or wrong.
    """
    lefts = images(path, r"l_\d+")
    if not lefts:
        raise DatasetError(f"{path}: expected images l_1.png, l_2.png, found none")
    size = size_of(*lefts)
    own = size == _OWN_SIZE
    rig = nominal_rig(path, size)
    if own:
        width, height = size
        rig = rectified_rig(
            path, size, fx=_OWN_FX, cx=width / 2, cy=height / 2, baseline_m=_BASELINE_M
        )
    files = []
    for index, left in enumerate(lefts):
        number = left.stem.removeprefix("l_")
        truth = path / f"d_{number}.exr"
        files.append(
            FrameFiles(
                left,
                image_beside(left, path, f"r_{number}"),
                nominal_ns(index, None),
                read_truth=partial(_truth, truth) if truth.is_file() else None,
            )
        )
    return StereoSource(path.name, rig, None, files, metric=own)


def _truth(path: Path) -> Truth:
    return Truth(known_offsets(read_exr(path)))
