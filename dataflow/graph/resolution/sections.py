"""Reads sections of a graph: that of the flight recorder, `record: {keep: 60s, when: [...]}`, and `network:`."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Collection

from dataflow.graph.problems import did_you_mean
from dataflow.graph.sections import Flight, Network, Trigger
from dataflow.graph.yaml.fields import Fields
from dataflow.graph.yaml.tree import Items, Leaf, Table, Tree, plain

FLIGHT_KEYS = ("keep", "after", "when", "folder", "files", "disk")
AFTER = 10_000_000_000
LONGEST = 86_400_000_000_000
MOST_FILES = 10_000
EXPECTED = "raise, {drops: N}, or {stream: ..., field: ..., above|below|equals: ...}"
_ENDPOINT = re.compile(r"(tcp|udp|tls|quic|ws|unixsock-stream|vsock|serial|unixpipe)/[^\s#?]+([?#][^\s]*)?")
_WITH_PORT = ("tcp", "udp", "tls", "quic", "ws")
_ZENOH_MESSAGE = re.compile(r'msg: "(.*?)"[,)]', re.DOTALL)


def read_flight(
    table: Table, fields: Fields, operators: Collection[str], streams_of: Callable[[Tree | None, str], tuple[str, ...]]
) -> Flight | None:
    """The flight recorder of a graph, or None. `streams_of` finds the streams that a key expression matches."""
    given = [key for key in FLIGHT_KEYS if table.get(key) is not None]
    if not given:
        return None
    if table.get("keep") is None:
        fields.problems.add(
            table.entries[given[0]].key.place,
            f"{given[0]!r} is of a flight recorder: say how much it keeps, such as keep: 60s",
        )
        return None
    keep = fields.duration(table.get("keep"), "keep") or 0
    after = AFTER if table.get("after") is None else fields.duration(table.get("after"), "after") or 0
    if not 0 < keep <= LONGEST or after > LONGEST:
        fields.problems.add(table.entries["keep"].value.place, "keep must be more than 0, keep and after a day at most")
        return None
    when = table.get("when")
    items = () if when is None else when.items if isinstance(when, Items) else (when,)
    triggers = [trigger for item in items for trigger in _triggers(item, fields, operators, streams_of)]
    folder = fields.text(table.get("folder"), "folder") or "flight"
    files = fields.integer(table.get("files"), "files", 1, MOST_FILES) or 20
    return Flight(keep, after, tuple(triggers), folder, files, fields.size(table.get("disk"), "disk"))


def _triggers(
    item: Tree, fields: Fields, operators: Collection[str], streams_of: Callable[[Tree | None, str], tuple[str, ...]]
) -> list[Trigger]:
    if isinstance(item, Leaf) and item.value == "raise":
        return [Trigger("raise")]
    if not isinstance(item, Table):
        fields.wrong(item, "when", EXPECTED)
        return []
    if "drops" in item.entries:
        fields.table(item, "when", ("drops", "operator"))
        rate, operator = _number(item, "drops", fields), fields.text(item.get("operator"), "operator") or ""
        if operator and operator not in operators:
            hint = did_you_mean(operator, operators, "there are")
            fields.problems.add(item.entries["operator"].value.place, f"no operator {operator!r}", hint)
            return []
        return [] if rate is None else [Trigger("drops", operator=operator, above=rate)]
    fields.table(item, "when", ("stream", "field", "above", "below", "equals"))
    field = fields.text(item.get("field"), "field")
    above, below = _number(item, "above", fields), _number(item, "below", fields)
    limited, equals = above is not None or below is not None, item.get("equals")
    if item.get("stream") is None or field is None or not (limited or isinstance(equals, Leaf)):
        fields.wrong(item, "when", EXPECTED)
        return []
    same = equals.value if isinstance(equals, Leaf) else None
    return [
        Trigger("field", stream=stream, field=field, above=above, below=below, equals=same)
        for stream in streams_of(item.get("stream"), "when")
    ]


def _number(item: Table, name: str, fields: Fields) -> float | None:
    value = item.get(name)
    if isinstance(value, Leaf) and isinstance(value.value, int | float) and not isinstance(value.value, bool):
        return float(value.value)
    if value is not None:
        fields.wrong(value, name, "a number")
    return None


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
