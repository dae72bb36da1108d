"""From a graph's `network:` section to how one process takes part in the network."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable

from dataflow.graph.sections import Network
from dataflow.transport import BusError, NetworkConfig
from dataflow.transport.bounded import within

BLOCKED, BLOCKED_LIVE = 30.0, 2.0
"""Seconds that a publication waits for a subscriber that takes nothing. A live run loses messages rather than time."""
LEAVE_WITHIN = 4.5
"""Seconds for taking leave of whom is connected from outside: less than any run gives its processes to close."""


def network_config(network: Network, listen: Iterable[str], *, live: bool) -> NetworkConfig:
    """Returns a process's configuration: its own endpoints, and the graph's settings for TLS and other machines."""
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


def leave_network(process: str, *closes: Callable[[], None]) -> None:
    """Closes parts of a process's place in the network in turn, and prints a warning if `LEAVE_WITHIN` is too short.
    All work is done by then: a neighbour that hangs must not fail the run."""

    def leave() -> None:
        for close in closes:
            close()

    try:
        late = "" if within(LEAVE_WITHIN, leave, "leave") else f"not done within {LEAVE_WITHIN:g} s"
    except BusError as error:
        late = str(error)
    if late:
        print(f"process {process!r} leaves the network unheard: {late}", file=sys.stderr)
