"""ETH3D two-view: ``eth3d:ROOT/two_view_training/playground_1l``.

::

    two_view_training/SCENE       calib.txt im0.png im1.png    as Middlebury's
                                  cameras.txt images.txt       COLMAP's; not read
    two_view_training_gt/SCENE    disp0GT.pfm mask0nocc.png    or in the folder of the scene

A scene with Middlebury's calibration is ETH3D's if COLMAP's ``cameras.txt`` is beside it, or if it
is in a folder ``two_view_*``; else it is Middlebury's.
"""

from pathlib import Path

from vergence_proto.datasets import middlebury
from vergence_proto.datasets.source import StereoSource


def find(root: Path) -> list[Path]:
    """List every scene of ETH3D in or under ``root``."""
    return [path for path in middlebury.find_all(root) if middlebury.is_eth3d(path)]


def open_path(path: Path) -> StereoSource:
    """Open one scene. Raises DatasetError: a file is missing or wrong."""
    beside = path.parent.with_name(f"{path.parent.name}_gt") / path.name
    return middlebury.open_scene(path, truth_folder=beside if beside.is_dir() else path)
