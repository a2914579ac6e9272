"""From a configuration to its network: the one place that knows every architecture."""

from __future__ import annotations

from typing import TypeAlias

from vergence_models.config import ConfigError, LiteNetworkConfig, NetworkConfig, RaftNetworkConfig
from vergence_models.lite.network import LiteNetwork
from vergence_models.network import StereoNetwork
from vergence_models.raft.network import RaftNetwork

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
