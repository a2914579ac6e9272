"""Weights and everything that changes while they are trained."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from vergence_models.config import Config, Precision
from vergence_models.data.clips import StereoClips
from vergence_models.networks.base import AnyNetwork, State
from vergence_models.networks.factory import build_network
from vergence_models.networks.losses import masked_mean
from vergence_models.training.camera_motion import perturbed, uvd_transforms
from vergence_models.training.runs import (
    CHECKPOINT_NAME,
    TrainingProgress,
    carry_over,
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


class Window(NamedTuple):
    """A part of an image, as shares of its height and width from 0 to 1."""

    top: float
    bottom: float
    left: float
    right: float

    @classmethod
    def draw(cls, random: np.random.Generator) -> Window:
        (top, bottom), (left, right) = np.sort(random.random((2, 2)), axis=1).tolist()
        return cls(top, bottom, left, right)


def cutmix_state(state: State, window: Window) -> State:
    """Replace a window of each state by that of another clip of the batch.

    The network learns to drop wrong surfaces. A wrong pose or a moving object leaves such surfaces
    behind too; here they have any place and size.
    """

    def mixed(tensor: Tensor) -> Tensor:
        height, width = tensor.shape[2:]
        rows = slice(round(window.top * height), round(window.bottom * height))
        columns = slice(round(window.left * width), round(window.right * width))
        result = tensor.clone()
        result[:, :, rows, columns] = tensor.roll(1, dims=0)[:, :, rows, columns]
        return result

    return tuple(mixed(tensor) for tensor in state)


@dataclass(frozen=True, slots=True)
class FrameSchedule:
    """The conditions under which training steps one frame of a batch."""

    reset: bool  # the frame starts without a state
    cutmix: Window | None  # the part of the state that comes from another clip
    iterations: int


class Unrolled(NamedTuple):
    """The steps of a whole batch of clips, before any weight changes."""

    loss: Tensor  # a scalar, with its gradient
    errors_px: list[float]  # the mean error of each frame


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
        self.progress = TrainingProgress()
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
        """Continue from a run's checkpoint. Raises RunError if its configuration differs."""
        contents = load_checkpoint(folder)
        require_same_network(contents, self.config, folder / CHECKPOINT_NAME)
        load_weights(self.network, contents["weights"], str(folder / CHECKPOINT_NAME))
        self.average = {k: v.to(self.device) for k, v in contents["average"].items()}
        self.optimizer.load_state_dict(contents["optimizer"])
        self.random.bit_generator.state = contents["random"]
        self.progress = TrainingProgress(**contents["progress"])
        self.measured = contents["measured"]
        self.commands = contents["story"]["commands"]

    def start_from(self, folder: Path) -> list[str]:
        """Take over the averaged weights and the story of another run, of fewer parts perhaps.

        The optimizer starts from zero. The learning rate goes on by the run's steps. Returns the
        names of weights that the run lacks, which begin untrained. Raises RunError if its
        configuration differs.
        """
        contents = load_checkpoint(folder)
        path = folder / CHECKPOINT_NAME
        require_same_network(contents, self.config, path)
        missing = carry_over(self.network, contents["average"], str(path))
        self.average = {k: v.detach().clone() for k, v in self.network.state_dict().items()}
        self.progress = TrainingProgress(**contents["progress"])
        self.commands = contents["story"]["commands"]
        return missing

    def autocast(self) -> torch.autocast:
        """Convolutions and matrix products in the precision that was asked for."""
        wanted = self.config.training.precision is Precision.BF16
        return torch.autocast(self.device.type, torch.bfloat16, enabled=wanted)

    def chance(self, share: float) -> bool:
        return bool(self.random.random() < share)

    def transforms(self, clips: StereoClips) -> Tensor:
        """The motion that the network sees, float32 [B, T, 4, 4]: true, noisy, or none."""
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
        matrices = self.transforms(clips).to(self.device)
        schedule = self.schedule(clips.frames)
        unrolled = self.unroll(clips.to(self.device), matrices, schedule)
        norm = self.update(unrolled.loss)
        self.progress.steps += 1
        self.progress.frames += len(clips) * clips.frames
        first, *later = unrolled.errors_px
        return {
            "loss": unrolled.loss.item(),
            "norm": norm,
            "first": first,
            "later": float(np.mean(later)) if later else first,
        }

    def schedule(self, frames: int) -> list[FrameSchedule]:
        """Draw the conditions of each frame of a batch."""
        training = self.config.training
        scheduled = []
        for frame in range(frames):
            reset = frame == 0 or self.chance(training.reset_share)
            cutmix = not reset and self.chance(training.cutmix_share)
            window = Window.draw(self.random) if cutmix else None
            iterations = (
                int(self.random.integers(1, training.cold_iterations + 1))
                if reset
                else 1 + int(self.chance(0.2))
            )
            scheduled.append(FrameSchedule(reset, window, iterations))
        return scheduled

    def unroll(
        self, clips: StereoClips, matrices: Tensor, schedule: Sequence[FrameSchedule]
    ) -> Unrolled:
        """Step through the clips by a schedule; ``matrices`` are the motion, [B, T, 4, 4]."""
        height, width = clips.disparity_px.shape[2:]
        state = cold = self.network.cold_state(len(clips), height, width)
        loss = torch.zeros((), device=self.device)
        errors_px = []
        for frame, planned in enumerate(schedule):
            if planned.reset:
                state = cold
            elif planned.cutmix is not None:
                state = cutmix_state(state, planned.cutmix)
            with self.autocast():
                estimate, state = self.network(
                    *clips.pair(frame), matrices[:, frame], state, planned.iterations
                )
            truth = clips.disparity_px[:, frame]
            frame_loss = estimate.loss(truth, self.config.network.max_disparity_px)
            loss = loss + frame_loss / clips.frames
            error = masked_mean((estimate.disparity.detach() - truth).abs(), (truth > 0).float())
            errors_px.append(error.item())
        return Unrolled(loss, errors_px)

    def update(self, loss: Tensor) -> float:
        """Change the weights by the gradient of a loss, and move their average; returns its norm.

        A gradient that is not finite changes no weight: one bad batch must not end a long run.
        """
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(self.config, self.progress.steps)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]  # torch annotates it so
        norm = torch.nn.utils.clip_grad_norm_(
            self.network.parameters(), self.config.training.gradient_norm
        )
        if torch.isfinite(norm):
            self.optimizer.step()
        # A young average follows quickly, an old one slowly.
        steps = self.progress.steps
        decay = min(self.config.training.ema_decay, (1 + steps) / (10 + steps))
        for name, value in self.network.state_dict().items():
            if value.is_floating_point():
                self.average[name].lerp_(value, 1 - decay)
            else:  # a count of batches
                self.average[name].copy_(value)
        return norm.item()

    def averaged_network(self) -> AnyNetwork:
        """The network with the averaged weights: the one to validate and export."""
        network = build_network(self.config.network).to(self.device).eval()
        network.load_state_dict(self.average)
        return network
