"""Middlebury 2001 to 2006, one pair: ``middlebury2006:ROOT/FullSize/Aloe``.

::

    2005, 2006  view1.png view5.png  disp1.png  dmin.txt      scale 1, 2, 3: Full, Half, ThirdSize
                (2005: also below Illum1/Exp1, a truth for all of them one level up)
    2003        im2.png im6.png      disp2.png                scale 4 at 450x375, 2 at half size,
                                                              1 at full size
    2001        im2.ppm im6.ppm      disp2.pgm                scale 8
                (map: im0.pgm im1.pgm disp0.pgm; tsukuba: scene1.row3.col3.ppm, .col4.ppm and
                truedisp.row3.col3.pgm, scale 16)

Truth is a grey image of 8 bits, disparity times scale, 0 unknown. The scale follows from the
folder's name or the size of the images; ``?scale=N`` states it. Of 2005 and 2006 the full-size
focal length is 3740 px, the baseline 160 mm, and dmin.txt holds what cropping took off the
disparity (the distance of the principal points). Other scenes state no camera: their rig is
nominal, and lengths are metres only at full size with a dmin.txt.
"""

from functools import partial
from pathlib import Path

from vergence_proto.datasets.files import DatasetError, numbers, read_lines
from vergence_proto.datasets.listing import found, image_beside
from vergence_proto.datasets.packings import nominal_rig, read_scaled, size_of
from vergence_proto.datasets.source import FrameFiles, StereoSource, Truth, rectified_rig
from vergence_proto.types import StereoRig

_VIEWS = (
    ("view1", "view5", "disp1"),
    ("im2", "im6", "disp2"),
    ("scene1.row3.col3", "scene1.row3.col4", "truedisp.row3.col3"),
    ("im0", "im1", "disp0"),
)
_VIEW_SCALES = {"scene1.row3.col3": 16.0, "im0": 8.0}
_FOLDER_SCALES = {"FullSize": 1.0, "HalfSize": 2.0, "ThirdSize": 3.0}
_FX_FULL = 3740.0
_BASELINE_M = 0.16


def find(root: Path) -> list[Path]:
    """List every scene in or under ``root``."""
    lefts = (path for left, _, _ in _VIEWS for path in found(root, f"{left}.*"))
    return sorted({path.parent for path in lefts if _images(path.parent) is not None})


def open_path(path: Path, *, scale: float | None = None) -> StereoSource:
    """Open one pair.

    Raises DatasetError: a file is missing or wrong, or ``scale`` is needed and not given.
    """
    views = _images(path)
    if views is None:
        raise DatasetError(f"{path}: expected view1.png and view5.png, or im2.png and im6.png")
    left, right, truth_name = views
    scene = path.parents[1] if path.name.startswith("Exp") and len(path.parents) > 1 else path
    truth = image_beside(left, scene, truth_name)
    size = size_of(left)
    scale = scale or _scale(path, left, size)
    if scale is None and truth.is_file():
        raise DatasetError(
            f"{path}: images of {size[0]}x{size[1]} have none of the data set's own sizes, so the "
            f"scale of {truth.name} is unknown; add it: middlebury2006:{path}?scale=N"
        )
    pair = FrameFiles(
        left,
        right,
        capture_ns=0,
        read_truth=partial(_truth, truth, scale) if truth.is_file() and scale else None,
    )
    name = scene.name if scene == path else "_".join((scene.name, *path.parts[-2:]))
    dmin = scene / "dmin.txt"
    if not (dmin.is_file() and scale):
        return StereoSource(name, nominal_rig(path, size), None, [pair], metric=False)
    rig = _read_rig(dmin, size, scale)
    return StereoSource(name, rig, None, [pair], metric=scale == 1)


def _images(path: Path) -> tuple[Path, Path, str] | None:
    for left_name, right_name, truth in _VIEWS:
        left = image_beside(Path("any.png"), path, left_name)
        right = image_beside(left, path, right_name)
        if left_name == "im0" and left.suffix.lower() != ".pgm":
            continue  # of another data set
        if left.is_file() and right.is_file():
            return left, right, truth
    return None


def _scale(path: Path, left: Path, size: tuple[int, int]) -> float | None:
    if left.stem in _VIEW_SCALES:
        return _VIEW_SCALES[left.stem]
    for part in reversed(path.parts):
        if part in _FOLDER_SCALES:
            return _FOLDER_SCALES[part]
    width, _ = size
    if left.stem == "view1":
        widths = ((1200, 1400, 1.0), (600, 700, 2.0), (400, 470, 3.0))
    elif size == (450, 375):
        return 4.0
    else:
        widths = ((1700, 1900, 1.0), (850, 950, 2.0), (425, 440, 8.0))
    return next((scale for low, high, scale in widths if low <= width <= high), None)


def _read_rig(dmin: Path, size: tuple[int, int], scale: float) -> StereoRig:
    words = " ".join(read_lines(dmin, "the disparity that cropping took off"))
    (cropped_px,) = numbers(words, 1, str(dmin))
    width, height = size
    cx = (width - 1) / 2
    return rectified_rig(
        dmin,
        size,
        fx=_FX_FULL / scale,
        cx=cx,
        cx_right=cx + cropped_px / scale,
        cy=(height - 1) / 2,
        baseline_m=_BASELINE_M,
    )


def _truth(path: Path, scale: float) -> Truth:
    return Truth(read_scaled(path, scale, bits=8))
