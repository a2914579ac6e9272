"""Readers of stereo data on disk: each gives a :class:`StereoSource` from ``KIND:PATH``."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from vergence_proto.layouts import kitti, vergence_layout
from vergence_proto.layouts.files import LayoutError
from vergence_proto.layouts.images import (
    read_disparity_png,
    read_image,
    read_pfm,
    write_disparity_png,
    write_pfm,
)
from vergence_proto.layouts.source import SourceFrame, StereoSource, Truth

__all__ = [
    "LAYOUTS",
    "LayoutError",
    "SourceFrame",
    "StereoSource",
    "Truth",
    "find_sources",
    "open_source",
    "read_disparity_png",
    "read_image",
    "read_pfm",
    "write_disparity_png",
    "write_pfm",
]

_NAMED_AT_MOST = 12


@dataclass(frozen=True, slots=True)
class Layout:
    open_path: Callable[[Path], StereoSource]
    find: Callable[[Path], list[Path]]  # what open_path takes, in or under a folder


LAYOUTS = {
    "vergence": Layout(vergence_layout.open_path, vergence_layout.find),
    "kitti": Layout(kitti.open_path, kitti.find),
}


def open_source(spec: str) -> StereoSource:
    """Open ``KIND:PATH``; calibration and poses are read at once, images as they are asked for.

    Raises LayoutError: an unknown kind, a path that is not one source (those under it are named),
    or a file that is missing or wrong.
    """
    kind, path = _parsed(spec)
    layout = LAYOUTS[kind]
    try:
        return layout.open_path(path)
    except LayoutError as error:
        found = [each for each in layout.find(path) if each != path]
        if not found:
            raise
        named = ", ".join(f"{kind}:{each}" for each in found[:_NAMED_AT_MOST])
        more = f" and {len(found) - _NAMED_AT_MOST} more" if len(found) > _NAMED_AT_MOST else ""
        raise LayoutError(f"{error}; {path} holds others, take one: {named}{more}") from None


def find_sources(spec: str) -> list[str]:
    """Every source in or under the folder of ``KIND:PATH``, each as :func:`open_source` takes it.

    Raises LayoutError: an unknown kind, or no such folder.
    """
    kind, path = _parsed(spec)
    return [f"{kind}:{each}" for each in LAYOUTS[kind].find(path)]


def _parsed(spec: str) -> tuple[str, Path]:
    kind, colon, path = spec.partition(":")
    if not colon or kind not in LAYOUTS:
        kinds = ", ".join(f"{known}:PATH" for known in LAYOUTS)
        raise LayoutError(f"{spec!r}: expected one of {kinds}")
    if not (Path(path).is_dir() or Path(path).parent.is_dir()):
        raise LayoutError(f"{path}: no such folder")
    return kind, Path(path)
