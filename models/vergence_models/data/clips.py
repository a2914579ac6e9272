"""A batch of stereo clips: the value that generator and pools pass to training."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Self

import torch
from torch import Tensor


@dataclass(frozen=True, slots=True, eq=False)
class StereoClips:
    """B clips of T rectified stereo frames with exact ground truth.

    Pixel centres lie at integer coordinates. Axes are OpenCV's: x right, y down, z forward.
    """

    left: Tensor  # uint8 [B, T, H, W, 3], RGB
    right: Tensor  # same shape as left
    disparity_px: Tensor  # float32 [B, T, H, W], u_left - u_right > 0; 0: nothing there (sky)
    visible: Tensor  # bool [B, T, H, W]: the left pixel's surface point is seen by the right eye
    world_from_left: Tensor  # float64 [B, T, 4, 4], metres
    fx: Tensor  # float32 [B], pixels; likewise fy, cx, cy
    fy: Tensor
    cx: Tensor
    cy: Tensor
    baseline_m: Tensor  # float32 [B]

    def __len__(self) -> int:
        return self.left.shape[0]

    @property
    def frames(self) -> int:
        return self.left.shape[1]

    def pair(self, frame: int) -> tuple[Tensor, Tensor]:
        """Left and right images of one frame of every clip, uint8 [B, H, W, 3], contiguous."""
        return self.left[:, frame].contiguous(), self.right[:, frame].contiguous()

    def __getitem__(self, clips: slice) -> Self:
        return type(self)(*(getattr(self, f.name)[clips] for f in fields(self)))

    def to(self, device: torch.device | str) -> Self:
        """The same clips on another device."""
        moved = (getattr(self, f.name).to(device, non_blocking=True) for f in fields(self))
        return type(self)(*moved)

    @classmethod
    def concatenate(cls, parts: list[Self]) -> Self:
        """Join batches of one image size and length."""
        return cls(*(torch.cat([getattr(p, f.name) for p in parts]) for f in fields(cls)))
