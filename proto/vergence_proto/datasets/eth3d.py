"""ETH3D two-view: ``eth3d:ROOT/two_view_training/playground_1l``.

Calibration and images are as Middlebury's; the truth lies in a folder beside,
``ROOT/two_view_training_gt/playground_1l`` (or in the scene's own).
"""

from pathlib import Path

from vergence_proto.datasets import middlebury
from vergence_proto.datasets.source import StereoSource

find = middlebury.find


def open_path(path: Path) -> StereoSource:
    """Raises LayoutError: a file is missing or wrong."""
    beside = path.parent.with_name(f"{path.parent.name}_gt") / path.name
    return middlebury.open_scene(path, truth_folder=beside if beside.is_dir() else path)
