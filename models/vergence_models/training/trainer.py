"""Weights and everything that changes while they are trained."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from vergence_models.config import Config, Precision
from vergence_models.data.clips import StereoClips
from vergence_models.networks.base import AnyNetwork, State
from vergence_models.networks.factory import build_network
from vergence_models.training.motion import perturbed, uvd_transforms
from vergence_models.training.runs import (
    CHECKPOINT_NAME,
    Progress,
    load_checkpoint,
    load_weights,
    require_same_network,
    save_checkpoint,
)


def learning_rate(config: Config, step: int) -> float:
    """Linear warm-up, cosine to a tenth, then constant: a run can always be extended."""
    training = config.training
    warm = min(1.0, (step + 1) / training.warmup_steps)
    done = min(1.0, step / training.decay_steps)
    return training.learning_rate * warm * (0.1 + 0.45 * (1 + math.cos(math.pi * done)))


def partly_foreign(state: State, random: np.random.Generator) -> State:
    """The state with a window of it from another clip of the batch: surfaces to let go of again.

    What a wrong pose or something that moved leaves behind, but anywhere and of any size.
    """
    (top, bottom), (left, right) = np.sort(random.random((2, 2)), axis=1)

    def mixed(tensor: Tensor) -> Tensor:
        height, width = tensor.shape[2:]
        rows = slice(round(top * height), round(bottom * height))
        columns = slice(round(left * width), round(right * width))
        result = tensor.clone()
        result[:, :, rows, columns] = tensor.roll(1, dims=0)[:, :, rows, columns]
        return result

    return tuple(mixed(tensor) for tensor in state)


class Trainer:
    """Weights and everything that changes while they are trained."""

    def __init__(self, config: Config, device: torch.device) -> None:
        torch.manual_seed(config.training.seed)
        self.config = config
        self.device = device
        self.network = build_network(config.network).to(device)
        # The layout of the kernels for it. On one thread of a busy CPU with AMX a step of `full`, 8
        # frames of 256x192, took 5 s so, 7 s in the other layout, and 15 s in float32.
        if config.training.precision is Precision.BF16:
            self.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = {k: v.detach().clone() for k, v in self.network.state_dict().items()}
        self.optimizer = torch.optim.AdamW(
            self.network.parameters(),
            lr=config.training.learning_rate,
            betas=(0.9, 0.99),
            weight_decay=config.training.weight_decay,
        )
        self.random = np.random.default_rng(config.training.seed)
        self.progress = Progress()
        self.measured: dict[str, float] = {}
        self.commands: list[str] = []

    def save(self, folder: Path) -> None:
        training = self.config.training
        story = {
            "commands": self.commands,
            **dataclasses.asdict(self.progress),
            "device": self.device.type,
            "seed": training.seed,
        }
        save_checkpoint(
            folder,
            {
                "config": self.config.name,
                "network": dataclasses.asdict(self.config.network),
                "weights": self.network.state_dict(),
                "average": self.average,
                "optimizer": self.optimizer.state_dict(),
                "random": self.random.bit_generator.state,
                "progress": dataclasses.asdict(self.progress),
                "story": story,
                "measured": self.measured,
            },
        )

    def resume(self, folder: Path) -> None:
        """Go on from a run's checkpoint. Raises RunError if it is of another configuration."""
        contents = load_checkpoint(folder)
        require_same_network(contents, self.config, folder / CHECKPOINT_NAME)
        load_weights(self.network, contents["weights"], str(folder / CHECKPOINT_NAME))
        self.average = {k: v.to(self.device) for k, v in contents["average"].items()}
        self.optimizer.load_state_dict(contents["optimizer"])
        self.random.bit_generator.state = contents["random"]
        self.progress = Progress(**contents["progress"])
        self.measured = contents["measured"]
        self.commands = contents["story"]["commands"]

    def autocast(self) -> torch.autocast:
        """Convolutions and matrix products in the precision that was asked for."""
        wanted = self.config.training.precision is Precision.BF16
        return torch.autocast(self.device.type, torch.bfloat16, enabled=wanted)

    def chance(self, share: float) -> bool:
        return bool(self.random.random() < share)

    def transforms(self, clips: StereoClips) -> Tensor:
        """The motion the network is told, float32 [B, T, 4, 4]: true, noisy, or none at all."""
        training = self.config.training
        poses = clips.world_from_left
        if self.chance(training.identity_share):
            poses = poses[:, :1].expand_as(poses)
        elif self.chance(training.noise_share):
            poses = perturbed(
                poses, max_deg=training.noise_deg, max_m=training.noise_m, random=self.random
            )
        return uvd_transforms(clips, poses)

    def step(self, clips: StereoClips) -> dict[str, float]:
        """One update on a batch of clips, with the gradient through the whole clip."""
        training, network = self.config.training, self.network
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(self.config, self.progress.steps)
        matrices = self.transforms(clips).to(self.device)
        clips = clips.to(self.device)
        batch, frames, _, height, width = clips.left.shape
        state = cold = network.cold_state(batch, height, width)
        loss = torch.zeros((), device=self.device)
        errors = []
        for frame in range(frames):
            reset = frame == 0 or self.chance(training.reset_share)
            if reset:
                state = cold
            elif self.chance(training.foreign_share):
                state = partly_foreign(state, self.random)
            most = training.cold_iterations
            iterations = (
                int(self.random.integers(1, most + 1)) if reset else 1 + int(self.chance(0.2))
            )
            left, right = (
                eye[:, frame].permute(0, 2, 3, 1).contiguous() for eye in (clips.left, clips.right)
            )
            with self.autocast():
                estimate, state = network(left, right, matrices[:, frame], state, iterations)
            truth = clips.disparity_px[:, frame]
            loss = loss + estimate.loss(truth, self.config.network.max_disparity_px) / frames
            errors.append((estimate.disparity.detach() - truth).abs()[truth > 0].mean().item())
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]  # torch annotates it so
        norm = torch.nn.utils.clip_grad_norm_(network.parameters(), training.gradient_norm)
        if torch.isfinite(norm):  # one bad batch must not end a long run
            self.optimizer.step()
        # A young average follows quickly, an old one slowly.
        decay = min(training.ema_decay, (1 + self.progress.steps) / (10 + self.progress.steps))
        for name, value in network.state_dict().items():
            if value.is_floating_point():
                self.average[name].lerp_(value, 1 - decay)
            else:  # a count of batches
                self.average[name].copy_(value)
        self.progress.steps += 1
        self.progress.frames += batch * frames
        return {
            "loss": loss.item(),
            "norm": norm.item(),
            "first": errors[0],
            "later": float(np.mean(errors[1:])) if frames > 1 else errors[0],
        }

    def averaged_network(self) -> AnyNetwork:
        """The network with the averaged weights: the one to validate and export."""
        network = build_network(self.config.network).to(self.device).eval()
        network.load_state_dict(self.average)
        return network
