"""From a configuration to its network: the one place that knows every architecture."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

from torch import Tensor

from vergence_models.config import ConfigError, LiteNetworkConfig, NetworkConfig, RaftNetworkConfig
from vergence_models.lite.network import LiteNetwork
from vergence_models.network import StereoNetwork
from vergence_models.raft.network import RaftNetwork
from vergence_models.runs import Run, RunError

# Callers need no more than the fields that all configurations share.
AnyNetwork: TypeAlias = StereoNetwork[NetworkConfig]


def build_network(config: NetworkConfig) -> AnyNetwork:
    """A new network of that shape, with the initial weights of torch's current seed."""
    match config:
        case LiteNetworkConfig():
            return LiteNetwork(config)
        case RaftNetworkConfig():
            return RaftNetwork(config)
        case _:
            raise ConfigError(f"no architecture for a {type(config).__name__}")


def load_weights(network: AnyNetwork, weights: Mapping[str, Tensor], source: str) -> None:
    """Give a network the weights of a run. Raises RunError if they are of another architecture.

    Architectures change while configurations keep their names; nothing but shapes tells.
    """
    expected = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    got = {name: tuple(tensor.shape) for name, tensor in weights.items()}
    for name in sorted(expected | got):
        if expected.get(name) != got.get(name):
            raise RunError(
                f"{source}: expected weights of today's architecture, these are of another: "
                f"{name} is {got.get(name, 'missing')}, expected {expected.get(name, 'none')}; "
                "use the version of the project they were trained with"
            )
    network.load_state_dict(weights)


def trained_network(run: Run) -> AnyNetwork:
    """The averaged weights of a run, for inference. Raises RunError."""
    network = build_network(run.network).eval()
    load_weights(network, run.weights, run.source)
    return network
