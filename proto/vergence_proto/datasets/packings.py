"""How data sets pack disparity and masks into files, and the rig of those that state none."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vergence_proto.datasets.files import DatasetError, existing
from vergence_proto.datasets.images import read_image, read_stored
from vergence_proto.datasets.source import Mask, rectified_rig
from vergence_proto.types import Plane, StereoRig

_NOMINAL_BASELINE_M = 0.1


def size_of(*paths: Path) -> tuple[int, int]:
    """Read the width and height of the first image that can be read.

    Raises DatasetError: all files are missing or damaged; the error is that of the first.
    """
    first: DatasetError | None = None
    for path in paths:
        try:
            height, width = read_image(path).shape[:2]
        except DatasetError as error:
            first = first or error
        else:
            return width, height
    raise first or DatasetError("expected an image to read the size of, got none")


def nominal_rig(origin: Path, size: tuple[int, int]) -> StereoRig:
    """Make a nominal rig for images without calibration: its focal length is the width."""
    width, height = size
    return rectified_rig(
        origin,
        size,
        fx=float(width),
        cx=(width - 1) / 2,
        cy=(height - 1) / 2,
        baseline_m=_NOMINAL_BASELINE_M,
    )


def read_grey(path: Path) -> NDArray[Any]:
    """Read a one-channel PNG or PGM as it is stored; three equal channels become one.

    Raises DatasetError: the file is missing, damaged or coloured.
    """
    stored = read_stored(path)
    if stored.ndim == 3 and all(np.array_equal(stored[..., 0], stored[..., k]) for k in (1, 2)):
        stored = stored[..., 0]
    if stored.ndim != 2:
        raise DatasetError(f"{path}: expected a grey image, got {list(stored.shape)}")
    return stored


def read_scaled(path: Path, steps_per_px: float, *, bits: int = 16) -> Plane:
    """Read a disparity that is stored times ``steps_per_px``; 0 is unknown.

    Raises DatasetError: the file is missing, damaged, or not of ``bits`` bits.
    """
    stored = read_grey(path)
    if stored.dtype != np.dtype(f"uint{bits}"):
        raise DatasetError(
            f"{path}: expected a {bits}-bit grey image (disparity x{steps_per_px:g}), "
            f"got {stored.dtype}"
        )
    offset_px = (stored / steps_per_px).astype(np.float32)
    offset_px[stored == 0] = np.nan
    return offset_px


def read_mask(path: Path) -> Mask:
    """Read where a grey image is not 0.

    Raises DatasetError: the file is missing, damaged or coloured.
    """
    return np.asarray(read_grey(path) != 0)


def read_npy(path: Path, purpose: str) -> NDArray[Any]:
    """Read a plane from an .npy.

    Raises DatasetError: the file is missing, damaged, or not [H, W].
    """
    existing(path, purpose)
    try:
        plane = np.load(path)
    except (ValueError, EOFError, OSError) as error:
        raise DatasetError(f"{path}: no readable .npy: {error}") from None
    if plane.ndim != 2:
        raise DatasetError(f"{path}: expected {purpose} [H, W], got {list(plane.shape)}")
    return np.asarray(plane)


def offsets_of_either_sign(values: NDArray[Any]) -> Plane:
    """Return u_left - u_right in pixels; NaN where it is not finite.

    Some files store u_right - u_left: if no value is positive, the sign is turned.
    """
    offset_px = np.array(values, np.float32)
    offset_px[~np.isfinite(offset_px)] = np.nan
    return offset_px if (offset_px > 0).any() else -offset_px


def known_offsets(values: NDArray[Any]) -> Plane:
    """Return disparity of either sign as positive pixels; NaN where it is 0 or not finite."""
    offset_px = offsets_of_either_sign(values)
    offset_px[~(offset_px > 0)] = np.nan
    return offset_px


def offsets_from_depth(depth_m: NDArray[Any], px_m: float) -> Plane:
    """Return ``px_m / depth``; ``px_m`` is focal length times baseline. NaN without a depth."""
    offset_px = np.full(depth_m.shape, np.nan, np.float32)
    known = np.isfinite(depth_m) & (depth_m > 0)
    offset_px[known] = px_m / depth_m[known]
    return offset_px
