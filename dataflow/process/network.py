"""From a graph's `network:` section to how one process takes part in the network."""

from __future__ import annotations

from collections.abc import Iterable

from dataflow.graph.model import Network
from dataflow.transport import NetworkConfig


def network_config(network: Network, listen: Iterable[str], connect: Iterable[str]) -> NetworkConfig:
    """The configuration of a process: its own endpoints, and what the graph says of TLS, access and other machines."""
    settings = {
        "transport/link/tls": dict(network.tls),
        "access_control": dict(network.access_control),
        "scouting/multicast/enabled": network.scouting,
    }
    return NetworkConfig(
        listen=tuple(listen),
        connect=(*connect, *network.connect),
        shared_memory=network.shared_memory,
        exposed=not network.loopback_only,
        zenoh={path: value for path, value in settings.items() if value},
    )
