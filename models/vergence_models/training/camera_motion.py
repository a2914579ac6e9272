"""Camera motion for batches of clips: poses to the (u, v, d) transforms that the network takes."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from vergence_models.data.clips import StereoClips


def xyzw_from_uvd(clips: StereoClips) -> Tensor:
    """Homogeneous points of the left camera from (u, v, d, 1): float64 [B, 4, 4]."""
    fx, fy, cx, cy, baseline_m = (
        getattr(clips, name).double() for name in ("fx", "fy", "cx", "cy", "baseline_m")
    )
    q = torch.zeros(len(clips), 4, 4, dtype=torch.float64)
    q[:, 0, 0] = 1
    q[:, 0, 3] = -cx
    q[:, 1, 1] = fx / fy
    q[:, 1, 3] = -cy * fx / fy
    q[:, 2, 3] = fx
    q[:, 3, 2] = 1 / baseline_m
    return q


def uvd_transforms(clips: StereoClips, world_from_left: Tensor) -> Tensor:
    """``uvd_curr_from_prev`` of every frame, float32 [B, T, 4, 4]; the first is the identity.

    ``world_from_left`` float64 [B, T, 4, 4]: the clips' own poses, or others in their place.
    """
    poses = world_from_left.cpu()
    curr_from_world = torch.linalg.inv(poses[:, 1:])
    curr_from_prev = curr_from_world @ poses[:, :-1]
    q = xyzw_from_uvd(clips)[:, None]
    uvd = torch.linalg.inv(q) @ curr_from_prev @ q
    first = torch.eye(4, dtype=torch.float64).expand(len(clips), 1, 4, 4)
    return torch.cat((first, uvd), dim=1).float()


def perturbed(
    world_from_left: Tensor, *, max_deg: float, max_m: float, random: np.random.Generator
) -> Tensor:
    """Poses with independent errors per frame, of a size drawn per clip up to the limits."""
    batch, frames = world_from_left.shape[:2]
    size = torch.from_numpy(random.random((batch, 1, 1)))

    def vectors() -> Tensor:
        return size * torch.from_numpy(random.standard_normal((batch, frames, 3))) / 3**0.5

    rotation = vectors() * torch.deg2rad(torch.tensor(max_deg, dtype=torch.float64))
    noise = torch.eye(4, dtype=torch.float64).repeat(batch, frames, 1, 1)
    zero = torch.zeros_like(rotation[..., 0])
    x, y, z = rotation.unbind(-1)
    skew = torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), dim=-1).view(batch, frames, 3, 3)
    noise[..., :3, :3] = torch.linalg.matrix_exp(skew)
    noise[..., :3, 3] = vectors() * max_m
    return world_from_left.cpu() @ noise
