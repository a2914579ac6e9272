"""Readers of stereo data on disk: each gives a :class:`StereoSource` from ``KIND:PATH``.

=============  =================================  ==================================================
kind           one source is                      it has
=============  =================================  ==================================================
``vergence``   a sequence or a pair               poses; dense or sparse truth
``kitti``      ``ROOT/sequences/00``              poses, where ``ROOT/poses/00.txt`` is there
``kitti2012``  ``ROOT/training/000046``, a pair   LiDAR truth
``kitti2015``  ``ROOT/training/000046``, a pair   LiDAR truth
``sceneflow``  ``ROOT/frames_finalpass/A/B/0000`` poses, truth; of other renderers with ``?fx=PX``
``tartanair``  ``ENV/Easy/P001``                  poses, truth
``euroc``      ``MH_01_easy``                     unrectified; poses; no truth
``middlebury`` ``Motorcycle-perfect``, a pair     truth
``eth3d``      ``two_view_training/SCENE``,       truth
               a pair
=============  =================================  ==================================================

================== ========================================== ====================================
``sintel``         ``ROOT/training/final_left/alley_1``       truth; poses with the .cam files
``spring``         ``ROOT/train/0001``                        poses; truth, which needs h5py
``vkitti2``        ``ROOT/Scene01/clone``                     poses, truth
``kittiraw``       ``DATE/DATE_drive_0001_sync``              poses; LiDAR truth of its benchmark
``drivingstereo``  ``ROOT/train-left-image/DRIVE``            truth
``apollo``         ``ROOT/stereo_train_001``                  truth; no metres
``irs``            ``ROOT/Home/SCENE``                        truth
``flyingthings``   ``ROOT/train/image_clean/0000000``, a pair truth; no metres
``booster``        ``ROOT/train/balanced/SCENE``              truth
``instereo2k``     ``ROOT/train/part1/000000``, a pair        truth; no metres
``middlebury2006`` ``ROOT/FullSize/Aloe``, a pair             truth; of 2001 to 2006
================== ========================================== ====================================

Whatever the layout's own conventions, what comes out has OpenCV camera axes, metres, nanoseconds,
and truth as pixel offsets u_left - u_right. Each module states its layout.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from vergence_proto.datasets import (
    apollo,
    booster,
    drivingstereo,
    eth3d,
    euroc,
    flyingthings,
    instereo2k,
    irs,
    kitti,
    kitti_pairs,
    kittiraw,
    middlebury,
    middlebury2006,
    sceneflow,
    sintel,
    spring,
    tartanair,
    vergence_layout,
    vkitti2,
)
from vergence_proto.datasets.ahead import read_ahead
from vergence_proto.datasets.files import LayoutError, numbers
from vergence_proto.datasets.images import (
    encode_disparity_png,
    encode_pfm,
    read_disparity_png,
    read_image,
    read_pfm,
    write_disparity_png,
    write_pfm,
)
from vergence_proto.datasets.source import SourceFrame, StereoSource, Truth

__all__ = [
    "LAYOUTS",
    "LayoutError",
    "SourceFrame",
    "StereoSource",
    "Truth",
    "encode_disparity_png",
    "encode_pfm",
    "find_sources",
    "open_source",
    "read_ahead",
    "read_disparity_png",
    "read_image",
    "read_pfm",
    "write_disparity_png",
    "write_pfm",
]

_NAMED_AT_MOST = 12


@dataclass(frozen=True, slots=True)
class Layout:
    open_path: Callable[..., StereoSource]  # (Path, and each option as a keyword)
    find: Callable[[Path], list[Path]]  # what open_path takes, in or under a folder
    options: tuple[str, ...] = ()  # numbers that may follow the path: ?name=1.5


LAYOUTS = {
    "vergence": Layout(vergence_layout.open_path, vergence_layout.find),
    "kitti": Layout(kitti.open_path, kitti.find),
    "kitti2012": Layout(kitti_pairs.open_2012, kitti_pairs.find_2012),
    "kitti2015": Layout(kitti_pairs.open_2015, kitti_pairs.find_2015),
    "sceneflow": Layout(sceneflow.open_path, sceneflow.find, options=("fx",)),
    "tartanair": Layout(tartanair.open_path, tartanair.find),
    "euroc": Layout(euroc.open_path, euroc.find),
    "middlebury": Layout(middlebury.open_path, middlebury.find),
    "eth3d": Layout(eth3d.open_path, eth3d.find),
    "sintel": Layout(sintel.open_path, sintel.find),
    "spring": Layout(spring.open_path, spring.find),
    "vkitti2": Layout(vkitti2.open_path, vkitti2.find),
    "booster": Layout(booster.open_path, booster.find),
    "instereo2k": Layout(instereo2k.open_path, instereo2k.find),
    "drivingstereo": Layout(drivingstereo.open_path, drivingstereo.find),
    "middlebury2006": Layout(middlebury2006.open_path, middlebury2006.find, options=("scale",)),
    "kittiraw": Layout(kittiraw.open_path, kittiraw.find),
    "flyingthings": Layout(flyingthings.open_path, flyingthings.find),
    "irs": Layout(irs.open_path, irs.find),
    "apollo": Layout(apollo.open_path, apollo.find, options=("steps",)),
}


def open_source(spec: str) -> StereoSource:
    """Open ``KIND:PATH``; calibration and poses are read at once, images as they are asked for.

    Raises LayoutError: an unknown kind, a path that is not one source (those under it are named),
    or a file that is missing or wrong.
    """
    kind, path, options = _parsed(spec)
    try:
        return LAYOUTS[kind].open_path(path, **options)
    except LayoutError as error:
        found = [each for each in LAYOUTS[kind].find(path) if each != path]
        if not found:
            raise
        named = ", ".join(f"{kind}:{each}" for each in found[:_NAMED_AT_MOST])
        more = f" and {len(found) - _NAMED_AT_MOST} more" if len(found) > _NAMED_AT_MOST else ""
        raise LayoutError(f"{error}; {path} holds others, take one: {named}{more}") from None


def find_sources(spec: str) -> list[str]:
    """Every source in or under the folder of ``KIND:PATH``, each as :func:`open_source` takes it.

    Raises LayoutError: an unknown kind, or no such folder.
    """
    kind, path, _ = _parsed(spec)
    _, question, options = spec.partition("?")
    return [f"{kind}:{each}{question}{options}" for each in LAYOUTS[kind].find(path)]


def _parsed(spec: str) -> tuple[str, Path, dict[str, float]]:
    kind, colon, rest = spec.partition(":")
    if not colon or kind not in LAYOUTS:
        kinds = ", ".join(f"{known}:PATH" for known in LAYOUTS)
        raise LayoutError(f"{spec!r}: expected one of {kinds}")
    location, _, query = rest.partition("?")
    path = Path(location)
    if not (path.is_dir() or path.parent.is_dir()):
        raise LayoutError(f"{path}: no such folder")
    options = {}
    for option in filter(None, query.split("&")):
        name, _, value = option.partition("=")
        if name not in LAYOUTS[kind].options:
            known = ", ".join(LAYOUTS[kind].options) or "none"
            raise LayoutError(f"{spec!r}: unknown option {name!r}; {kind}: takes {known}")
        options[name] = numbers(value, 1, f"{spec!r}, {name}")[0]
    return kind, path, options
