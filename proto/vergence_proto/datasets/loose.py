"""Images without a calibration: two files, or a folder with a left and a right part.

::

    left.EXT, right.EXT         a pair
    left/*.EXT, right/*.EXT     a sequence, in the order of its names

Or the names are im0 and im1, image_left and image_right, or cam0 and cam1.

These are no data set of :data:`vergence_proto.datasets.DATASETS`: the caller knows the cameras, or
nobody does.
"""

import re
from collections.abc import Callable
from pathlib import Path

from vergence_proto.datasets.files import DatasetError
from vergence_proto.datasets.listing import images, number_in
from vergence_proto.datasets.packings import nominal_rig, size_of
from vergence_proto.datasets.source import FrameFiles, StereoSource, nominal_ns
from vergence_proto.types import StereoRig

_SIDES = (("left", "right"), ("im0", "im1"), ("image_left", "image_right"), ("cam0", "cam1"))

RigOf = Callable[[tuple[int, int]], StereoRig | None]
"""Makes the rig of images of a width and height; None: the calibration is not known."""


def open_images(left: Path, right: Path, rig_of: RigOf) -> StereoSource:
    """Open two images as a pair.

    Raises DatasetError: a file is missing or is no image, or the images differ in size.
    """
    (width, height), (right_width, right_height) = size_of(left), size_of(right)
    if (width, height) != (right_width, right_height):
        raise DatasetError(
            f"{right}: expected {width}x{height} as {left.name} has, "
            f"got {right_width}x{right_height}"
        )
    name = left.stem if left.stem != right.stem else left.resolve().parent.name
    return _source(name, [FrameFiles(left, right, capture_ns=0)], rig_of)


def open_image_folder(folder: Path, rig_of: RigOf) -> StereoSource | None:
    """Open the two images or the two folders of images in ``folder``; None: there are none.

    Images belong together by the last number in their names, if most numbers are on both sides;
    else in order. Raises DatasetError: then there are not as many left as right.
    """
    for names in _SIDES:
        pair = [path for name in names for path in images(folder, name)]
        if len(pair) == len(names):
            return open_images(pair[0], pair[1], rig_of)
        lefts, rights = (images(folder / name, ".*") for name in names)
        if not (lefts and rights):
            continue
        pairs = _by_number(lefts, rights)
        if pairs is None and len(lefts) != len(rights):
            raise DatasetError(
                f"{folder}: expected as many images in {names[0]} as in {names[1]}, "
                f"got {len(lefts)} and {len(rights)}"
            )
        files = [
            FrameFiles(left, right, nominal_ns(index, None))
            for index, (left, right) in enumerate(pairs or zip(lefts, rights, strict=True))
        ]
        return _source(folder.resolve().name, files, rig_of)
    return None


def _by_number(lefts: list[Path], rights: list[Path]) -> list[tuple[Path, Path]] | None:
    """Pair up images by number; one that has no partner is listed with the name it should have."""
    sides = []
    for paths in (lefts, rights):
        numbered = {number_in(path): path for path in paths if re.search(r"\d", path.stem)}
        if len(numbered) < len(paths):
            return None  # a name has no number, or two have the same one
        sides.append(numbered)
    left, right = sides
    if 2 * len(left.keys() & right.keys()) < max(len(left), len(right)):
        return None
    return [
        (
            left.get(number) or lefts[0].with_name(right[number].name),
            right.get(number) or rights[0].with_name(left[number].name),
        )
        for number in sorted(left.keys() | right.keys())
    ]


def _source(name: str, files: list[FrameFiles], rig_of: RigOf) -> StereoSource:
    size = size_of(*(each.left for each in files))
    rig = rig_of(size)
    if rig is None:
        return StereoSource(name, nominal_rig(files[0].left, size), None, files, metric=False)
    return StereoSource(name, rig, None, files)
