"""ETH3D two-view: ``eth3d:ROOT/two_view_training/playground_1l``.

Calibration and images have Middlebury's layout. The truth is in a separate folder,
``ROOT/two_view_training_gt/playground_1l``, or in the folder of the scene.
"""

from pathlib import Path

from vergence_proto.datasets import middlebury
from vergence_proto.datasets.source import StereoSource


def find(root: Path) -> list[Path]:
    """List every scene in or under ``root``."""
    return middlebury.find(root)


def open_path(path: Path) -> StereoSource:
    """Open one scene. Raises DatasetError: a file is missing or wrong."""
    beside = path.parent.with_name(f"{path.parent.name}_gt") / path.name
    return middlebury.open_scene(path, truth_folder=beside if beside.is_dir() else path)
