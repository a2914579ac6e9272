"""The shape and the training of each tier's network, as frozen values."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum


class ConfigError(ValueError):
    """A configuration is unknown, or differs from the one a file was made with."""


class Precision(StrEnum):
    """The number type of convolutions and matrix products in training; weights stay float32.

    Geometry, losses and what onnxruntime runs are float32 in either case.
    """

    FP32 = "fp32"
    BF16 = "bf16"


@dataclass(frozen=True, slots=True)
class NetworkConfig:
    """The shape of one network. Widths are channel counts; scales are fixed by the code."""

    max_disparity_px: int = 192
    stride: int = 32  # H and W are multiples of it


@dataclass(frozen=True, slots=True)
class LiteNetworkConfig(NetworkConfig):
    """The shape of `lite`."""

    fine_bits: int = 16  # census comparisons per cell at 1/4 (48 would be 1 % better)
    coarse_bits: int = 48  # census comparisons per cell at 1/8, from the quarter-size image
    context_quarter: int = 32
    context_eighth: int = 48
    context_low: int = 64  # 1/16 and 1/32
    cost_channels: int = 16  # width of the filter that all coarse disparities share
    hidden: int = 32  # recurrent state at 1/8
    fine_channels: int = 32
    fine_low: int = 48  # width of the refinement's layers at 1/8


@dataclass(frozen=True, slots=True)
class RaftNetworkConfig(NetworkConfig):
    """The shape of `full` and `fast`."""

    warp: bool = True  # warp the state to the new view; otherwise it keeps its place
    encoder_half: int = 64  # encoder width at 1/2
    encoder_quarter: int = 96  # encoder width at 1/4
    encoder_eighth: int = 128  # encoder width at 1/8 and 1/16
    features: int = 256  # channels of the matched features at 1/8
    hidden: int = 128  # recurrent state at 1/8 and at 1/16
    motion: int = 64  # width of each half of the motion encoder
    head: int = 256  # inner width of the heads


@dataclass(frozen=True, slots=True)
class TrainingConfig:
    """The settings of training; each is an option of the same name on the command line."""

    seed: int = 1
    batch: int = 2
    frames: int = 4  # frames of a clip in a batch
    learning_rate: float = 1e-3
    warmup_steps: int = 200
    decay_steps: int = 5_000  # cosine from the peak to a tenth of it, then constant
    weight_decay: float = 1e-5
    gradient_norm: float = 1.0
    ema_decay: float = 0.997
    stretch_share: float = 0.5  # share of clips that are enlarged to larger disparities
    identity_share: float = 0.05  # share of clips without motion, for clients without poses
    noise_share: float = 0.3  # share of clips with noisy poses, up to the next two limits
    noise_deg: float = 0.3  # largest rotation error of a pose
    noise_m: float = 0.002  # largest translation error of a pose
    clean_share: float = 0.3  # share of clips without the sensor's flaws
    blinded_share: float = 0.0  # share of clips in which an eye or both see nothing for a while
    unmatched_share: float = 0.0  # share of clips in which the right eye sees something else
    repeating_share: float = 0.0  # share of clips with a pattern that repeats along the rows
    reset_share: float = 0.1  # share of frames that lose their state
    cutmix_share: float = 0.1  # share of frames whose state is partly that of another clip
    cold_iterations: int = 4  # most iterations of a frame without a state; the number is random
    precision: Precision = Precision.FP32


@dataclass(frozen=True, slots=True, order=True)
class StepKind:
    """A kind of step that has a graph of its own; its text is part of the graph's file name."""

    iterations: int
    at_2x: int = 0  # so many of the last iterations run at twice the size, in cold steps alone

    def __str__(self) -> str:
        return f"{self.iterations}_cold" if self.at_2x else str(self.iterations)


@dataclass(frozen=True, slots=True)
class Config:
    """One tier."""

    name: str
    network: NetworkConfig
    training: TrainingConfig = field(default_factory=TrainingConfig)
    iterations: tuple[int, ...] = (1, 2, 4, 8)  # graphs to export
    # Cold starts with graphs of their own: iterations -> so many of the last ones run at 2x.
    iterations_at_2x: Mapping[int, int] = field(default_factory=dict)
    max_pixels_at_2x: int = 1280 * 1024  # largest image; memory grows with the power of 1.5


# The pool's clips are windows of a sharper camera, so fewer need to be enlarged. Resets and cold
# iterations are frequent because single pairs must be good too.
LITE_TRAINING = TrainingConfig(
    frames=5,
    decay_steps=36_000,
    ema_decay=0.999,
    stretch_share=0.3,
    blinded_share=0.16,
    unmatched_share=0.06,
    repeating_share=0.12,
    reset_share=0.3,
    cold_iterations=6,
)
# The paper's settings: Adam, no weight decay, an L1 loss that weighs every frame alike.
RAFT_TRAINING = TrainingConfig(
    learning_rate=4e-4, weight_decay=0.0, cold_iterations=6, precision=Precision.BF16
)
FAST_NETWORK = RaftNetworkConfig(
    warp=False,
    encoder_half=32,
    encoder_quarter=48,
    encoder_eighth=64,
    features=128,
    hidden=64,
    motion=32,
    head=128,
)

CONFIGS = {
    config.name: config
    for config in (
        Config("lite", LiteNetworkConfig(), LITE_TRAINING, iterations_at_2x={8: 2}),
        Config("full", RaftNetworkConfig(), RAFT_TRAINING, iterations=(1, 2, 5, 7, 20)),
        Config("fast", FAST_NETWORK, RAFT_TRAINING, iterations=(1, 2, 5, 7, 20)),
    )
}


def load_config(name: str) -> Config:
    """The tier of that name. Raises ConfigError, which lists the known names."""
    try:
        return CONFIGS[name]
    except KeyError:
        raise ConfigError(f"no configuration {name!r}; there are: {', '.join(CONFIGS)}") from None


def network_from_dict(tier: str, values: dict[str, int], source: str) -> NetworkConfig:
    """The inverse of ``dataclasses.asdict`` for a tier's network. Raises ConfigError."""
    kind = type(load_config(tier).network)
    known = {entry.name for entry in dataclasses.fields(kind)}
    if set(values) != known:
        odd = ", ".join(sorted(set(values) ^ known))
        raise ConfigError(f"{source}: expected the fields of {kind.__name__}, these differ: {odd}")
    return kind(**values)
