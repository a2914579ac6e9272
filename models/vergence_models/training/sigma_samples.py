"""Pixels of a frozen network for the training of its sigma: what it is made of, and the true error.

The network steps over augmented clips, with and without evidence, cold and warm, as it does in
training. Nothing that sigma is made of depends on the weights of the sigma head, so the clips are
stepped once and the head is trained on the pixels as often as need be.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from vergence_models.config import StepKind, TrainingConfig
from vergence_models.data.pool import ClipPool
from vergence_models.networks.base import StepOutput
from vergence_models.networks.lite.ambiguity import ambiguity
from vergence_models.networks.lite.network import LiteNetwork, LiteState
from vergence_models.networks.losses import judged_error
from vergence_models.progress import silent
from vergence_models.training.batches import batch_at
from vergence_models.training.camera_motion import perturbed, uvd_transforms

PIXELS = 3000  # of a frame
# Single iterations, live starts, lossless starts.
COLD_KINDS = (StepKind(1), StepKind(2), StepKind(4), StepKind(4), StepKind(8, at_2x=2))


class SigmaSamples(NamedTuple):
    """Pixels of many frames."""

    measures: Tensor  # [N, FEATURES]
    sigma: Tensor  # [N] px, of the refinement
    error_px: Tensor  # [N], as the loss judges it
    hidden: Tensor  # bool [N]: the images do not show the disparity
    cold: Tensor  # bool [N]


def sigma_samples(
    network: LiteNetwork,
    pools: Sequence[ClipPool],
    training: TrainingConfig,
    *,
    steps: range,
    on_step: Callable[[str], None] = silent,
) -> SigmaSamples:
    """The pixels of these batches, each of one of the pools in turn; the seed decides all."""
    parts: list[SigmaSamples] = []
    for step in steps:
        on_step(f"batch {step}")
        with torch.inference_mode():
            parts += _of_batch(network, pools[step % len(pools)], training, step)
    return SigmaSamples(*(torch.cat(columns) for columns in zip(*parts, strict=True)))


def _of_batch(
    network: LiteNetwork, pool: ClipPool, training: TrainingConfig, step: int
) -> list[SigmaSamples]:
    clips = batch_at(step, pool, training)
    random = np.random.default_rng((training.seed, step, 1))
    poses = clips.world_from_left
    if random.random() < training.identity_share:
        poses = poses[:, :1].expand_as(poses)
    elif random.random() < training.noise_share:
        limits = {"max_deg": training.noise_deg, "max_m": training.noise_m}
        poses = perturbed(poses, **limits, random=random)
    matrices = uvd_transforms(clips, poses)
    found: list[SigmaSamples] = []
    state: LiteState | None = None
    for frame in range(clips.frames):
        left, right = clips.pair(frame)
        matching = network.search(left, right)
        cold = state is None or random.random() < training.reset_share
        if cold or state is None:
            kind = COLD_KINDS[random.integers(len(COLD_KINDS))]
            nothing = LiteState(*network.cold_state(*left.shape[:3]))
            estimate, after = network.iterated(matching, nothing, kind.iterations - kind.at_2x)
            step_found = StepOutput(estimate.disparity, estimate.sigma, after)
            if kind.at_2x:
                step_found = network.refine_at_2x(left, right, step_found, kind.at_2x)
        else:
            moved = network.moved(state, matrices[:, frame])
            estimate, after = network.iterated(matching, moved, 1)
            step_found = StepOutput(estimate.disparity, estimate.sigma, after)
        state = LiteState(*step_found.state)
        measures = ambiguity(step_found.sigma, state.disparity, matching.cost_features.fixed)
        truth = clips.disparity_px[:, frame]
        error = judged_error(step_found.disparity, truth, network.config.max_disparity_px)
        found.append(_drawn(step_found.sigma, measures, error, truth, cold, random))
    return found


def _drawn(
    sigma: Tensor,
    measures: Tensor,
    error: Tensor,
    truth: Tensor,
    cold: bool,
    random: np.random.Generator,
) -> SigmaSamples:
    """Some pixels of a frame of every clip, of those with a truth."""
    batch, height, width = truth.shape
    clip, v, u = (
        torch.from_numpy(random.integers(size, size=batch * PIXELS))
        for size in (batch, height, width)
    )
    with_truth = truth[clip, v, u] != 0
    clip, v, u = clip[with_truth], v[with_truth], u[with_truth]
    return SigmaSamples(
        measures[clip, :, v // 8, u // 8],
        sigma[clip, v, u],
        error[clip, v, u],
        truth[clip, v, u] < 0,
        torch.full_like(u, cold, dtype=torch.bool),
    )
