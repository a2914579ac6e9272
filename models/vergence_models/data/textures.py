"""A bank of square textures with mip levels, packed one texel to an int32, sampled anisotropically.

Photographs are read once and kept in a memory-mapped file; procedural textures are made on the
spot from a seed.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vergence_models.data.patterns import PATTERNS, pattern

Texture = NDArray[np.uint8]  # [S, S, 3], RGB
_PHOTO_SUFFIXES = {".jpg", ".jpeg", ".png", ".webp"}


class TextureBank:
    """K textures of S x S texels (a power of two), repeated by mirroring beyond their edges."""

    def __init__(self, texels: Tensor, *, kinds: tuple[str, ...], size: int) -> None:
        self._texels = texels  # int32 [levels concatenated, each K * s * s], bytes R G B 0
        self.kinds = kinds  # [K]: "photo", or the name of the pattern
        self.size = size
        count = len(kinds)
        sides = [size >> level for level in range(size.bit_length())]
        starts = np.concatenate([[0], np.cumsum([count * side * side for side in sides])])
        device = texels.device
        self._levels = len(sides)
        self._starts = torch.tensor(starts[:-1], device=device)

    @classmethod
    def create(
        cls,
        *,
        seed: int,
        photos: Path | None = None,
        patterns: int = 64,
        size: int = 256,
        device: torch.device | str = "cpu",
    ) -> TextureBank:
        """Make a bank from procedural patterns and, if given, a folder of photographs.

        FileNotFoundError means that the folder does not exist or holds no image.
        """
        rng = np.random.default_rng(seed)
        names = list(PATTERNS)
        kinds = tuple(names[k % len(names)] for k in range(patterns))
        levels = _pack_levels([pattern(rng, size, kind) for kind in kinds])
        if photos is not None:
            taken = _photo_levels(photos, size)
            levels = [np.concatenate(pair) for pair in zip(taken, levels, strict=True)]
            kinds = ("photo",) * len(taken[0]) + kinds
        texels = torch.from_numpy(np.concatenate([level.ravel() for level in levels]))
        return cls(texels.to(device), kinds=kinds, size=size)

    def sample(
        self, texture: Tensor, u: Tensor, v: Tensor, major: tuple[Tensor, Tensor], minor: Tensor
    ) -> Tensor:
        """RGB in 0..1, float32 [N, 3]: two bilinear taps along the footprint's major axis.

        Coordinates and footprint (the major half-axis as a vector, the minor as a length) are
        float32 [N] in texels of the finest level, texture is int64 [N].
        """
        length = (major[0] * major[0] + major[1] * major[1]).sqrt()
        footprint = torch.maximum(minor, length * 0.5).clamp(min=1.0)
        level = (footprint.log2() + 0.25).long().clamp(max=self._levels - 1)
        side = torch.bitwise_right_shift(self.size, level)
        start = self._starts.index_select(0, level) + texture * side * side
        scale = torch.exp2(-level.float())
        step_u, step_v = major[0] * 0.25, major[1] * 0.25
        first = self._bilinear(start, side, (u - step_u) * scale, (v - step_v) * scale)
        second = self._bilinear(start, side, (u + step_u) * scale, (v + step_v) * scale)
        return (first + second)[:, :3] * (0.5 / 255)

    def _bilinear(self, start: Tensor, side: Tensor, u: Tensor, v: Tensor) -> Tensor:
        u, v = u - 0.5, v - 0.5
        u0, v0 = u.floor(), v.floor()
        fu, fv = (u - u0)[:, None], (v - v0)[:, None]
        column, row = u0.long(), v0.long()
        left, right = _mirror(column, side), _mirror(column + 1, side)
        top = torch.addcmul(start, _mirror(row, side), side)
        bottom = torch.addcmul(start, _mirror(row + 1, side), side)
        upper = torch.lerp(self._texel(top + left), self._texel(top + right), fu)
        lower = torch.lerp(self._texel(bottom + left), self._texel(bottom + right), fu)
        return torch.lerp(upper, lower, fv)

    def _texel(self, index: Tensor) -> Tensor:
        """All four bytes of texels [N] as float32 [N, 4]: a copy without gaps is quicker."""
        return self._texels.index_select(0, index).view(torch.uint8).view(-1, 4).float()


def _mirror(index: Tensor, side: Tensor) -> Tensor:
    folded = index & (2 * side - 1)
    return torch.minimum(folded, 2 * side - 1 - folded)


def _pack_levels(images: list[Texture]) -> list[NDArray[np.int32]]:
    """Mip levels of K textures: int32 [K, s, s] for s = S, S/2, ..., 1."""
    size = images[0].shape[0]
    levels = []
    for level in range(size.bit_length()):
        side = size >> level
        packed = np.zeros((len(images), side, side, 4), np.uint8)
        for k, image in enumerate(images):
            packed[k, :, :, :3] = cv2.resize(image, (side, side), interpolation=cv2.INTER_AREA)
        levels.append(packed.view(np.int32)[..., 0])
    return levels


def _photo_levels(folder: Path, size: int) -> list[NDArray[np.int32]]:
    paths = sorted(p for p in folder.glob("*") if p.suffix.lower() in _PHOTO_SUFFIXES)
    if not paths:
        raise FileNotFoundError(f"no .jpg, .png or .webp photographs in {folder}")
    listing = "\n".join(f"{p.name} {p.stat().st_size}" for p in paths)
    digest = hashlib.sha256(f"{size}\n{listing}".encode()).hexdigest()[:16]
    atlas = Path(tempfile.gettempdir()) / f"vergence-textures-{os.getuid()}-{digest}.npy"
    if not atlas.exists():
        _write_whole(atlas, lambda file: np.save(file, np.stack([_square(p, size) for p in paths])))
    return _pack_levels(list(np.load(atlas, mmap_mode="r")))


def _square(path: Path, size: int) -> Texture:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise ValueError(f"not a readable image: {path}")
    side = min(image.shape[:2])
    y, x = (image.shape[0] - side) // 2, (image.shape[1] - side) // 2
    square = cv2.resize(
        image[y : y + side, x : x + side], (size, size), interpolation=cv2.INTER_AREA
    )
    return np.asarray(cv2.cvtColor(square, cv2.COLOR_BGR2RGB), np.uint8)


def _write_whole(path: Path, write: Callable[[str], None]) -> None:
    """Write beside the path and rename, so that nobody ever reads half a file."""
    partial = path.with_name(f"{path.stem}.{os.getpid()}.npy")
    write(str(partial))
    partial.replace(path)
