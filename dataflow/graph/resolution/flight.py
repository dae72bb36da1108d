"""Reads the flight recorder's section of a graph: `record: {keep: 60s, after: 10s, when: [...]}`."""

from __future__ import annotations

from collections.abc import Callable, Collection

from dataflow.graph.problems import did_you_mean
from dataflow.graph.sections import Flight, Trigger
from dataflow.graph.yaml.fields import Fields
from dataflow.graph.yaml.tree import Items, Leaf, Table, Tree

KEYS = ("keep", "after", "when", "folder", "files", "disk")
AFTER = 10_000_000_000
LONGEST = 86_400_000_000_000
MOST_FILES = 10_000
EXPECTED = "raise, {drops: N}, or {stream: ..., field: ..., above|below|equals: ...}"


def read_flight(
    table: Table, fields: Fields, operators: Collection[str], streams_of: Callable[[Tree | None, str], tuple[str, ...]]
) -> Flight | None:
    """The flight recorder of a graph, or None. `streams_of` finds the streams that a key expression matches."""
    given = [key for key in KEYS if table.get(key) is not None]
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
