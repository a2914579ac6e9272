"""Readers of stereo data sets on disk: each opens ``KIND:PATH`` as a :class:`StereoSource`.

=============  =================================  ==================================================
kind           one source                         it has
=============  =================================  ==================================================
``vergence``   a sequence or a pair               poses; dense or sparse truth
``kitti``      ``ROOT/sequences/00``              poses, if ``ROOT/poses/00.txt`` exists
``kitti2012``  ``ROOT/training/000046``, a pair   LiDAR truth
``kitti2015``  ``ROOT/training/000046``, a pair   LiDAR truth
``sceneflow``  ``ROOT/frames_finalpass/A/B/0000`` poses, truth; ``?fx=PX`` for other renderers
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
``mcap``           ``walk.mcap``, a recorded session          poses; needs the extra ``record``
================== ========================================== ====================================

Every source has OpenCV camera axes, metres, nanoseconds, and truth as pixel offsets
u_left - u_right, whatever the conventions of its data set. Each module states the layout of the
files that it reads.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
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
    recorded,
    sceneflow,
    sintel,
    spring,
    tartanair,
    vergence_format,
    vkitti2,
)
from vergence_proto.datasets.ahead import read_ahead
from vergence_proto.datasets.files import DatasetError, numbers
from vergence_proto.datasets.images import (
    beyond_png,
    encode_disparity_png,
    encode_pfm,
    read_disparity_png,
    read_image,
    read_pfm,
    write_disparity_png,
    write_pfm,
)
from vergence_proto.datasets.loose import open_image_folder, open_images
from vergence_proto.datasets.packings import nominal_rig
from vergence_proto.datasets.recorded import RecordedOptions, RecordedSource
from vergence_proto.datasets.source import SourceFrame, StereoSource, Truth, nominal_ns

__all__ = [
    "DATASETS",
    "DatasetError",
    "RecordedOptions",
    "RecordedSource",
    "SourceFrame",
    "StereoSource",
    "Truth",
    "beyond_png",
    "detect_sources",
    "encode_disparity_png",
    "encode_pfm",
    "find_sources",
    "nominal_ns",
    "nominal_rig",
    "open_image_folder",
    "open_images",
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
class Dataset:
    """One kind of data set: how its sources are found and opened."""

    open_path: Callable[..., StereoSource]
    """Open one source; takes its path, and each option as a keyword."""
    find: Callable[[Path], list[Path]]
    """List the paths of all sources in or under a folder."""
    options: tuple[str, ...] = ()
    """Names of the numbers that may follow the path: ``?name=1.5``."""


DATASETS = {
    "vergence": Dataset(vergence_format.open_path, vergence_format.find),
    "kitti": Dataset(kitti.open_path, kitti.find),
    "kitti2012": Dataset(kitti_pairs.open_2012, kitti_pairs.find_2012),
    "kitti2015": Dataset(kitti_pairs.open_2015, kitti_pairs.find_2015),
    "sceneflow": Dataset(sceneflow.open_path, sceneflow.find, options=("fx",)),
    "tartanair": Dataset(tartanair.open_path, tartanair.find),
    "euroc": Dataset(euroc.open_path, euroc.find),
    "middlebury": Dataset(middlebury.open_path, middlebury.find),
    "eth3d": Dataset(eth3d.open_path, eth3d.find),
    "sintel": Dataset(sintel.open_path, sintel.find),
    "spring": Dataset(spring.open_path, spring.find),
    "vkitti2": Dataset(vkitti2.open_path, vkitti2.find),
    "booster": Dataset(booster.open_path, booster.find),
    "instereo2k": Dataset(instereo2k.open_path, instereo2k.find),
    "drivingstereo": Dataset(drivingstereo.open_path, drivingstereo.find),
    "middlebury2006": Dataset(middlebury2006.open_path, middlebury2006.find, options=("scale",)),
    "kittiraw": Dataset(kittiraw.open_path, kittiraw.find),
    "flyingthings": Dataset(flyingthings.open_path, flyingthings.find),
    "irs": Dataset(irs.open_path, irs.find),
    "apollo": Dataset(apollo.open_path, apollo.find, options=("steps",)),
    "mcap": Dataset(recorded.open_path, recorded.find),
}


def open_source(spec: str) -> StereoSource:
    """Open ``KIND:PATH``. Calibration and poses are read now, each image when it is used.

    Raises DatasetError: the kind is unknown, the path is not one source (the message names the
    sources under it), or a file is missing or wrong.
    """
    kind, path, options = _parsed(spec)
    try:
        return _noted(DATASETS[kind].open_path(path, **options))
    except DatasetError as error:
        found = [each for each in DATASETS[kind].find(path) if each != path]
        if not found:
            raise
        named = ", ".join(f"{kind}:{each}" for each in found[:_NAMED_AT_MOST])
        more = f" and {len(found) - _NAMED_AT_MOST} more" if len(found) > _NAMED_AT_MOST else ""
        raise DatasetError(
            f"{error}; {path} holds other sources; name one of them: {named}{more}"
        ) from None


def find_sources(spec: str) -> list[str]:
    """List every source in or under the folder of ``KIND:PATH``, as :func:`open_source` takes it.

    Raises DatasetError: the kind is unknown, or there is no such folder.
    """
    kind, path, _ = _parsed(spec)
    options = spec.removeprefix(f"{kind}:").removeprefix(_location(spec))
    return [f"{kind}:{each}{options}" for each in DATASETS[kind].find(path)]


def detect_sources(folder: Path) -> list[str]:
    """List every source of any kind in or under ``folder``, as :func:`open_source` takes it.

    Kinds may share a layout: of those that claim one path, the one is listed that finds its truth.
    """
    claims: dict[Path, list[str]] = {}
    for kind, dataset in DATASETS.items():
        for path in dataset.find(folder):
            claims.setdefault(path, []).append(f"{kind}:{path}")
    return [specs[0] if len(specs) == 1 else _best(specs) for specs in claims.values()]


def _best(specs: list[str]) -> str:
    opened: dict[str, StereoSource] = {}
    for spec in specs:
        with suppress(DatasetError):
            opened[spec] = open_source(spec)
    with_truth = (spec for spec, source in opened.items() if source.has_truth)
    return next(with_truth, next(iter(opened), specs[0]))


def _noted(source: StereoSource) -> StereoSource:
    """Note that some frames lack the truth that others have."""
    without = sum(each.read_truth is None for each in source.files)
    if without in (0, len(source)):
        return source
    note = f"{without} of {len(source)} frames have no ground truth"
    return replace(source, notes=(*source.notes, note))


def _location(spec: str) -> str:
    """The path of a spec, without its options; a folder may have a question mark in its name."""
    rest = spec.partition(":")[2]
    return rest if Path(rest).exists() else rest.rpartition("?")[0] or rest


def _parsed(spec: str) -> tuple[str, Path, dict[str, float]]:
    kind, colon, rest = spec.partition(":")
    location = _location(spec)
    if not colon or kind not in DATASETS:
        kinds = ", ".join(f"{known}:PATH" for known in DATASETS)
        raise DatasetError(f"{spec!r}: expected one of {kinds}")
    query = rest.removeprefix(location).removeprefix("?")
    path = Path(location)
    if not (path.is_dir() or path.parent.is_dir()):
        raise DatasetError(f"{path}: no such folder")
    options = {}
    for option in filter(None, query.split("&")):
        name, _, value = option.partition("=")
        if name not in DATASETS[kind].options:
            known = ", ".join(DATASETS[kind].options) or "none"
            raise DatasetError(f"{spec!r}: unknown option {name!r}; {kind}: takes {known}")
        options[name] = numbers(value, 1, f"{spec!r}, {name}")[0]
    return kind, path, options
