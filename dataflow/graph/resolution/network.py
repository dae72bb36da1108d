"""The `network:` section of a graph: where processes listen and connect, tried on Zenoh's own configuration."""

from __future__ import annotations

import json
import re

from dataflow.graph.problems import did_you_mean
from dataflow.graph.sections import Network
from dataflow.graph.yaml.fields import Fields
from dataflow.graph.yaml.tree import Table, Tree, plain

_ENDPOINT = re.compile(r"(tcp|udp|tls|quic|ws|unixsock-stream|vsock|serial|unixpipe)/[^\s#?]+([?#][^\s]*)?")
_WITH_PORT = ("tcp", "udp", "tls", "quic", "ws")
_ZENOH_MESSAGE = re.compile(r'msg: "(.*?)"[,)]', re.DOTALL)


def read_network(tree: Tree | None, fields: Fields) -> Network:
    """The `network:` section; without one, loopback only."""
    keys = ("listen", "connect", "shared_memory", "scouting", "tls", "access_control")
    table = fields.table(tree, "network", keys)
    if table is None:
        return Network()
    shared = fields.boolean(table.get("shared_memory"), "shared_memory")
    return Network(
        listen=_endpoints(table.get("listen"), "listen", fields),
        connect=_endpoints(table.get("connect"), "connect", fields),
        shared_memory=True if shared is None else shared,
        scouting=bool(fields.boolean(table.get("scouting"), "scouting")),
        tls=_zenoh_part(table, "tls", "transport/link/tls", fields),
        access_control=_zenoh_part(table, "access_control", "access_control", fields),
    )


def _endpoints(tree: Tree | None, what: str, fields: Fields) -> tuple[str, ...]:
    words = fields.texts(tree, what)
    hint = "protocol/address:port, such as tcp/192.168.1.2:7447 or tls/robot1.local:7447"
    for leaf in words:
        if not _ENDPOINT.fullmatch(leaf.value):
            fields.problems.add(leaf.place, f"{what}: {leaf.value!r} is no Zenoh endpoint", hint)
        elif fault := _address_fault(leaf.value):
            fields.problems.add(leaf.place, f"{what}: {leaf.value!r} {fault}", hint)
    return tuple(leaf.value for leaf in words)


def _address_fault(endpoint: str) -> str | None:
    """Returns why an endpoint of a protocol with ports cannot be opened; names are not looked up."""
    protocol, _, rest = endpoint.partition("/")
    if protocol not in _WITH_PORT:
        return None
    host, colon, port = re.split(r"[?#]", rest)[0].rpartition(":")
    if not colon or not re.fullmatch(r"[0-9]{1,5}", port) or int(port) > 65535:
        return "has no port from 0 to 65535"
    if not host:
        return "has no host"
    if ":" in host and not (host.startswith("[") and host.endswith("]")):
        return "has an IPv6 address without [ ]"
    return None


def _zenoh_part(table: Table, key: str, path: str, fields: Fields) -> dict[str, object]:
    """A mapping for Zenoh's own configuration, tried on it."""
    part = fields.table(table.get(key), key)
    if part is None:
        return {}
    import zenoh  # a graph without such a section loads without the network library

    values: dict[str, object] = plain(part)
    try:
        zenoh.Config().insert_json5(path, json.dumps(values))
    except zenoh.ZError as error:
        told = _ZENOH_MESSAGE.search(str(error))
        message, _, expected = (told[1] if told else str(error)).partition(", expected one of ")
        field = re.search(r"unknown field `(\w+)`", message)
        hint = did_you_mean(field[1] if field else "", re.findall(r"`(\w+)`", expected), "Zenoh has")
        fields.problems.add(part.place, f"{key}: Zenoh refuses it: {message}", hint if expected else "")
    return values
