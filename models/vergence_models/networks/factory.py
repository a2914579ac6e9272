"""Builds the network of a configuration; the only module that imports every architecture."""

from __future__ import annotations

from vergence_models.config import ConfigError, LiteNetworkConfig, NetworkConfig, RaftNetworkConfig
from vergence_models.networks.base import AnyNetwork
from vergence_models.networks.lite.network import LiteNetwork
from vergence_models.networks.raft.network import RaftNetwork


def build_network(config: NetworkConfig) -> AnyNetwork:
    """A new network of that shape, with the initial weights of torch's current seed."""
    match config:
        case LiteNetworkConfig():
            return LiteNetwork(config)
        case RaftNetworkConfig():
            return RaftNetwork(config)
        case _:
            raise ConfigError(f"no architecture for a {type(config).__name__}")
