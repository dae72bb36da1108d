"""The `network:` section of a graph: where hosts listen and connect, tried on Zenoh's own configuration."""

from __future__ import annotations

import json
import re

import zenoh

from dataflow.graph.document import Table, Tree, plain
from dataflow.graph.fields import Fields
from dataflow.graph.model import Network
from dataflow.graph.problems import did_you_mean

_ENDPOINT = re.compile(r"(tcp|udp|tls|quic|ws|unixsock-stream|vsock|serial|unixpipe)/[^\s#?]+([?#][^\s]*)?")
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
    for leaf in words:
        if not _ENDPOINT.fullmatch(leaf.value):
            hint = "protocol/address:port, such as tcp/192.168.1.2:7447 or tls/robot1.local:7447"
            fields.problems.add(leaf.place, f"{what}: {leaf.value!r} is no Zenoh endpoint", hint)
    return tuple(leaf.value for leaf in words)


def _zenoh_part(table: Table, key: str, path: str, fields: Fields) -> dict[str, object]:
    """A mapping for Zenoh's own configuration, tried on it."""
    part = fields.table(table.get(key), key)
    if part is None:
        return {}
    values: dict[str, object] = plain(part)
    try:
        zenoh.Config().insert_json5(path, json.dumps(values))
    except zenoh.ZError as error:
        told = _ZENOH_MESSAGE.search(str(error))
        message, _, expected = (told[1] if told else str(error)).partition(", expected one of ")
        field = re.search(r"unknown field `(\w+)`", message)
        hint = did_you_mean(field[1] if field else "", re.findall(r"`(\w+)`", expected), "Zenoh knows")
        fields.problems.add(part.place, f"{key}: Zenoh refuses it: {message}", hint if expected else "")
    return values
