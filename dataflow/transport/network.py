"""Addresses on which a bus listens and connects, and the Zenoh configuration made of them. This machine only unless
told so."""

from __future__ import annotations

import ipaddress
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from zenoh import Config, ZError

_ENDPOINT = re.compile(r"(?P<protocol>[a-z][a-z0-9-]*)/(?P<address>[^?#\s]+)(?P<rest>[?#]\S*)?")
_LOCAL_PROTOCOLS = ("unixsock-stream", "unixpipe")


class NetworkError(ValueError):
    """An endpoint or a Zenoh setting is invalid; the message names it, and what would be right."""


@dataclass(frozen=True, slots=True)
class NetworkConfig:
    """Configuration of one process's part in the network.

    `listen` and `connect` are Zenoh endpoints such as `"unixsock-stream//run/user/1000/a"` or `"tcp/127.0.0.1:7447"`.
    Peers that are not up yet are tried again in the background until the bus is closed. An endpoint beyond this machine
    is refused in `listen` unless `exposed` is set: the graph's `network:` section asks for it.
    `blocked`: seconds that a publication waits for a subscriber that takes
    nothing; then its link is closed, and it misses messages until it has connected again. `zenoh` holds further
    settings of Zenoh's own configuration by path: `{"transport/link/tls": {...}, "access_control": {}}`.
    """

    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    exposed: bool = False
    blocked: float = 30.0
    zenoh: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for endpoint in (*self.listen, *self.connect):
            if _ENDPOINT.fullmatch(endpoint) is None:
                raise NetworkError(
                    f"endpoint {endpoint!r}: expected <protocol>/<address>, such as 'tcp/127.0.0.1:7447'"
                )
        if not self.exposed:
            for endpoint in self.listen:
                if not is_local(endpoint):
                    raise NetworkError(
                        f"endpoint {endpoint!r} can be reached from other machines; listen on 127.0.0.1, "
                        "or write the endpoint under `network: listen:` in the graph"
                    )

    def zenoh_config(self) -> Config:
        """The Zenoh configuration; raises `NetworkError` for a setting that Zenoh does not take."""
        config = Config()
        closing = {f"{_BLOCK}/wait_before_close": round(self.blocked * 1e6)}
        for path, value in (_BASE | closing | dict(self.zenoh)).items():
            _insert(config, path, value)
        _insert(config, "listen/endpoints", list(self.listen))
        _insert(config, "connect/endpoints", list(self.connect))
        return config


_BLOCK = "transport/link/tx/queue/congestion_control/block"
_BASE: dict[str, Any] = {
    "mode": "peer",
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "listen/exit_on_failure": True,
    # A peer that is not up yet: opening returns at once, and the connection is tried in the background without end.
    "connect/exit_on_failure": False,
    "connect/timeout_ms": -1,
    "connect/retry": {"period_init_ms": 20, "period_max_ms": 500, "period_increase_factor": 1.5},
    "open/return_conditions": {"connect_scouted": False, "declares": False},
    # A process that is stopped for a while (a debugger, swapping) keeps its links; one that dies is seen at once,
    # because its sockets close.
    "transport/link/tx/lease": 30_000,
    "transport/link/tx/keep_alive": 12,
    # Large messages are cut into pieces of 64 KB; Zenoh's default queue is two pieces (benchmarks/transport.md).
    "transport/link/tx/queue/size/data": 16,
    "transport/link/rx/buffer_size": 1 << 20,
    # Zenoh's own shared memory is slower here and leaves files behind (benchmarks/transport.md); ours is in shared.py.
    "transport/shared_memory/enabled": False,
}


def _insert(config: Config, path: str, value: Any) -> None:
    try:
        config.insert_json5(path, json.dumps(value))
    except (ZError, TypeError, ValueError) as error:
        raise NetworkError(f"Zenoh setting {path!r} = {value!r}: {error}") from None


def is_local(endpoint: str) -> bool:
    """True when only processes of this machine can reach `endpoint`."""
    found = _ENDPOINT.fullmatch(endpoint)
    if found is None:
        return False
    if found["protocol"] in _LOCAL_PROTOCOLS:
        return True
    if found["rest"] and "iface=" in found["rest"]:
        return False
    host = found["address"].rpartition(":")[0].strip("[]")
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
