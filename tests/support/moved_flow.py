"""The initial flow of a warm start in PyTorch, by the warp of our own networks."""

import numpy as np
import torch
from numpy.typing import NDArray

from vergence_models.networks.warp import (
    MIN_DISPARITY_PX,
    cell_centres,
    fill_cracks,
    splat_nearest,
    transform_uvd,
)


def moved_flow(
    disparity_px: NDArray[np.float32], uvd_curr_from_prev: NDArray[np.float32], *, cell_px: int
) -> torch.Tensor:
    """The disparity [H, W] of the last frame as a flow to the left, [1, 2, H/cell, W/cell]."""
    middle = cell_px // 2
    cells = torch.from_numpy(disparity_px[None, middle::cell_px, middle::cell_px].copy())
    _, height, width = cells.shape
    u, v = cell_centres(height, width, cell_px, cells)
    u_to, v_to, d_to = transform_uvd(torch.from_numpy(uvd_curr_from_prev)[None], u, v, cells)
    d_to = d_to * (cells > MIN_DISPARITY_PX)
    column, row = (torch.floor((each + 0.5) / cell_px) for each in (u_to, v_to))
    landed = fill_cracks(splat_nearest(d_to, column, row))
    x = -landed[:, None] / cell_px
    return torch.cat((x, torch.zeros_like(x)), dim=1)
