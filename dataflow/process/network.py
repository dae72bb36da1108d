"""From a graph's `network:` section to how one process takes part in the network."""

from __future__ import annotations

from collections.abc import Iterable

from dataflow.graph.sections import Network
from dataflow.transport import NetworkConfig

BLOCKED, BLOCKED_LIVE = 30.0, 2.0
"""Seconds that a publication waits for a subscriber that takes nothing. A live run loses messages rather than time."""


def network_config(network: Network, listen: Iterable[str], *, live: bool) -> NetworkConfig:
    """Returns a process's configuration: its own endpoints, and what the graph says of TLS and other machines."""
    settings = {
        "transport/link/tls": dict(network.tls),
        "access_control": dict(network.access_control),
        "scouting/multicast/enabled": network.scouting,
    }
    return NetworkConfig(
        listen=tuple(listen),
        connect=tuple(network.connect),
        blocked=BLOCKED_LIVE if live else BLOCKED,
        exposed=not network.loopback_only,
        zenoh={path: value for path, value in settings.items() if value},
    )
