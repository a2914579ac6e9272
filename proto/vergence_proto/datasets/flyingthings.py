"""FlyingThings3D's subset, one pair: ``flyingthings:ROOT/train/image_clean/0000000``.

::

    ROOT/train/image_clean image_final/left right/%07d.png     960x540
    ROOT/train/disparity/left/%07d.pfm                         u_right - u_left: negative pixels
    ROOT/train/disparity_occlusions/left/%07d.png              not 0: unseen by the right camera

The number is that of the files, no folder of the name exists; neighbouring numbers may belong to
different scenes. The subset has no cameras: SceneFlow's own, of 1050 px and one unit of Blender,
stand in.
"""

from functools import partial
from pathlib import Path

from vergence_proto.datasets.files import DatasetError
from vergence_proto.datasets.images import read_pfm
from vergence_proto.datasets.listing import found, image_beside, images
from vergence_proto.datasets.packings import known_offsets, nominal_rig, read_mask, size_of
from vergence_proto.datasets.source import FrameFiles, StereoSource, Truth, rectified_rig

_PASSES = ("image_clean", "image_final")
_OWN_SIZE = (960, 540)
_OWN_FX = 1050.0


def find(root: Path) -> list[Path]:
    """List every pair in or under ``root``, of either pass."""
    passes = [folder for name in _PASSES for folder in found(root, name)]
    if root.name in _PASSES:
        passes.append(root)
    return [each / image.stem for each in passes for image in images(each / "left", r"\d+")]


def open_path(path: Path) -> StereoSource:
    """Open one pair.

    Raises DatasetError: a file is missing or wrong.
    """
    folder, number = path.parent, path.name
    left = image_beside(Path("any.png"), folder / "left", number)
    if folder.name not in _PASSES or not left.is_file():
        raise DatasetError(
            f"{path}: expected the number of an image in {' or '.join(_PASSES)}, as in "
            "image_clean/0000000"
        )
    truth = folder.parent / "disparity" / "left" / f"{number}.pfm"
    hidden = folder.parent / "disparity_occlusions" / "left" / f"{number}.png"
    pair = FrameFiles(
        left,
        image_beside(left, folder / "right", number),
        capture_ns=0,
        read_truth=partial(_truth, truth, hidden) if truth.is_file() else None,
    )
    size = size_of(left)
    rig = nominal_rig(path, size)
    if size == _OWN_SIZE:
        rig = rectified_rig(path, size, fx=_OWN_FX, cx=479.5, cy=269.5, baseline_m=1.0)
    return StereoSource(number, rig, None, [pair], metric=False)


def _truth(path: Path, hidden: Path) -> Truth:
    offset_px = known_offsets(read_pfm(path))
    return Truth(offset_px, visible=~read_mask(hidden) if hidden.is_file() else None)
