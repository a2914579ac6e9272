"""The errors of a network on held-out synthetic clips; decisions in training rest on them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vergence_models.captions import captioned
from vergence_models.config import StepKind
from vergence_models.data.clips import StereoClips
from vergence_models.data.pool import ClipPool
from vergence_models.data.sensor import film_as_sensor
from vergence_models.networks.base import AnyNetwork, StepOutput
from vergence_models.networks.losses import known
from vergence_models.training.camera_motion import uvd_transforms

START = StepKind(4)  # how the first frame of a clip is stepped


def filmed(pool: ClipPool, indices: range) -> StereoClips:
    """Clips with camera flaws, the same at every call."""
    return film_as_sensor(pool.clips(indices), np.random.default_rng(indices.start))


@torch.inference_mode()
def predict(
    network: AnyNetwork, clips: StereoClips, device: torch.device, *, start: StepKind = START
) -> list[StepOutput]:
    """The output of every frame of the clips: a cold start, then one iteration a frame."""
    matrices = uvd_transforms(clips, clips.world_from_left).to(device)
    steps: list[StepOutput] = []
    for frame in range(clips.frames):
        left, right = (image.to(device) for image in clips.pair(frame))
        if steps:
            estimate, state = network(left, right, matrices[:, frame], steps[-1].state, 1)
            steps.append(StepOutput(estimate.disparity, estimate.sigma, state))
        else:
            steps.append(network.cold_step(left, right, start.iterations, at_2x=start.at_2x))
    return steps


def validate(
    network: AnyNetwork,
    pool: ClipPool,
    device: torch.device,
    *,
    clips: int = 48,
    start: StepKind = START,
) -> dict[str, float]:
    """Mean errors over the first ``clips`` of a pool: cold (frame 1) and warm (the others).

    EPE in px; D1 and D3 in percent; ``cover`` is the share of pixels, in percent, whose error is
    within sigma times ln 2: 50 where sigma is the scale of a Laplace distribution.
    """
    sums: dict[str, list[float]] = {}
    limit = network.config.max_disparity_px
    for first in range(0, min(clips, len(pool)), 8):
        part = filmed(pool, range(first, min(first + 8, clips, len(pool))))
        for frame, found in enumerate(predict(network, part, device, start=start)):
            truth = part.disparity_px[:, frame].to(device)
            mask = known(truth, limit) > 0
            errors = (found.disparity - truth).abs()[mask]
            kind = "warm" if frame else "cold"
            for name, value in measures(errors, found.sigma[mask]).items():
                sums.setdefault(f"{kind}_{name}", []).append(value)
    return {name: round(float(np.mean(values)), 4) for name, values in sums.items()}


def measures(errors: Tensor, sigma: Tensor) -> dict[str, float]:
    return {
        "epe": errors.mean().item(),
        "d1": 100 * (errors > 1).float().mean().item(),
        "d3": 100 * (errors > 3).float().mean().item(),
        "cover": 100 * (errors < sigma * np.log(2)).float().mean().item(),
    }


def save_picture(
    network: AnyNetwork, pool: ClipPool, path: Path, device: torch.device, *, clips: int = 6
) -> None:
    """A PNG with a row per clip: left image, truth, estimate, error, sigma of its last frame."""
    part = filmed(pool, range(min(clips, len(pool))))
    last = predict(network, part, device)[-1]
    rows = []
    for index in range(len(part)):
        image = part.left[index, -1].numpy()[..., ::-1]
        truth = part.disparity_px[index, -1].numpy()
        estimate, sigma = (t[index].cpu().numpy() for t in (last.disparity, last.sigma))
        top = max(float(truth.max()), 1.0)
        error = np.where(truth > 0, np.abs(estimate - truth), 0)
        panels = {
            "left image": image,
            f"truth, 0 to {top:.0f} px": painted(truth / top, cv2.COLORMAP_TURBO),
            "disparity": painted(estimate / top, cv2.COLORMAP_TURBO),
            "error, 0 to 4 px": painted(error / 4, cv2.COLORMAP_INFERNO),
            "sigma, 0 to 4 px": painted(sigma / 4, cv2.COLORMAP_INFERNO),
        }
        tiles = [captioned(panel, words, width=256) for words, panel in panels.items()]
        rows.append(np.concatenate(tiles, axis=1))
    cv2.imwrite(str(path), np.concatenate(rows, axis=0))


def painted(share: NDArray[np.floating[Any]], colormap: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.applyColorMap(to_bytes(share), colormap), np.uint8)


def to_bytes(share: NDArray[np.floating[Any]]) -> NDArray[np.uint8]:
    return np.asarray(np.clip(share, 0, 1) * 255, np.uint8)
