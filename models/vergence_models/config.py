"""What a network is made of and how it is trained: frozen values, one entry per tier."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum


class ConfigError(ValueError):
    """A configuration is unknown, or differs from the one a file was made with."""


class Precision(StrEnum):
    """What convolutions and matrix products are computed in while training; weights stay float32.

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
    """Of `lite`."""

    fine_bits: int = 16  # census comparisons per cell at 1/4 (48 would be 1 % better)
    coarse_bits: int = 48  # census comparisons per cell at 1/8, from the quarter-size image
    context_quarter: int = 32
    context_eighth: int = 48
    context_low: int = 64  # 1/16 and 1/32
    cost_channels: int = 16  # of the filter that all coarse disparities share
    hidden: int = 32  # recurrent state at 1/8
    fine_channels: int = 32
    fine_low: int = 48  # the refinement's view at 1/8


@dataclass(frozen=True, slots=True)
class RaftNetworkConfig(NetworkConfig):
    """Of `full` and `fast`."""

    warp: bool = True  # move the state to the new view; otherwise it stays where it was
    encoder_half: int = 64  # at 1/2
    encoder_quarter: int = 96
    encoder_eighth: int = 128  # and 1/16
    features: int = 256  # that are matched, at 1/8
    hidden: int = 128  # recurrent state at 1/8 and at 1/16
    motion: int = 64  # of each half of the motion encoder
    head: int = 256  # inner width of the heads


@dataclass(frozen=True, slots=True)
class TrainingConfig:
    """How a network is trained; every field can be reached by the same name on the command line."""

    seed: int = 1
    batch: int = 2
    frames: int = 4  # of a clip
    learning_rate: float = 1e-3
    warmup_steps: int = 200
    decay_steps: int = 5_000  # cosine from the peak to a tenth of it, then constant
    weight_decay: float = 1e-5
    gradient_norm: float = 1.0
    ema_decay: float = 0.997
    stretch_share: float = 0.5  # clips blown up to larger disparities
    identity_share: float = 0.05  # clips that hide the motion: the network must cope without poses
    noise_share: float = 0.3  # clips whose poses are off by up to the two limits below
    noise_deg: float = 0.3
    noise_m: float = 0.002
    clean_share: float = 0.3  # clips without the sensor's flaws
    reset_share: float = 0.1  # frames that lose their state
    cutmix_share: float = 0.1  # frames whose state is in part another clip's of the batch
    cold_iterations: int = 4  # at most, drawn anew for every frame without a state
    precision: Precision = Precision.FP32


@dataclass(frozen=True, slots=True, order=True)
class StepKind:
    """Of a step; as words, part of a file's name."""

    iterations: int
    at_2x: int = 0  # of the iterations, the last ones, in cold steps alone

    def __str__(self) -> str:
        return f"{self.iterations}_cold" if self.at_2x else str(self.iterations)


@dataclass(frozen=True, slots=True)
class Config:
    """One tier."""

    name: str
    network: NetworkConfig
    training: TrainingConfig = field(default_factory=TrainingConfig)
    iterations: tuple[int, ...] = (1, 2, 4, 8)  # graphs to export
    # Cold starts with graphs of their own: how many of their iterations are a closer look.
    iterations_at_2x: Mapping[int, int] = field(default_factory=dict)
    max_pixels_at_2x: int = 1280 * 1024  # of an image; memory grows with the power of 1.5


# Windows of a sharper camera need less blowing up; a stereo pair alone has to be good too, with
# more iterations than a stream starts with.
LITE_TRAINING = TrainingConfig(
    frames=5,
    decay_steps=36_000,
    ema_decay=0.999,
    stretch_share=0.3,
    reset_share=0.3,
    cold_iterations=6,
)
# The paper's: Adam, no weight decay, an L1 loss that weighs every frame alike.
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
    """The tier of that name. Raises ConfigError and names those there are."""
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
