"""The `--set` words of the command line: one parameter of an operator or of the graph, given from outside."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from dataflow.graph.problems import SETTINGS, Place, Problems
from dataflow.graph.yaml import document
from dataflow.graph.yaml.tree import UNKNOWN, Entry, Leaf, Table, Tree


@dataclass(slots=True)
class Setting:
    """One word: `owner` is the operator's full name (empty: the graph itself), `path` the parameter and keys inside."""

    owner: str
    path: tuple[str, ...]
    value: Tree
    place: Place
    used: bool = False


def read_settings(words: Sequence[str], problems: Problems) -> list[Setting]:
    """`operator.param=value` and `param=value` words; values are YAML. Faults stand in the file `--set`."""
    lines = list(words)
    if lines:
        problems.texts[SETTINGS] = lines
    settings = []
    for index, word in enumerate(words):
        name, equals, text = word.partition("=")
        place = Place(SETTINGS, index + 1, 1, max(1, len(name)))
        *owner, last = name.strip().split(".") if "." in name else ("", name.strip())
        if not equals or not last:
            hint = "write operator.param=value, or param=value for the graph's own"
            problems.add(place, f"{word!r} sets nothing", hint)
            continue
        padded = "\n" * index + " " * (len(name) + 1) + text
        value = document.parse(padded, SETTINGS, problems, lines)
        if value is None:
            value = Leaf(None, place) if not any(p.file == SETTINGS for p in problems.found) else Leaf(UNKNOWN, place)
        head, *inner = owner
        settings.append(Setting(head, (*inner, last), value, place))
    return settings


def put(table: Table, path: tuple[str, ...], setting: Setting) -> Table:
    """`table` with the setting's value at `path`."""
    head, *rest = path
    key = Leaf(head, setting.place, head)
    value = setting.value
    if rest:
        inner = table.get(head)
        value = put(inner if isinstance(inner, Table) else Table({}, setting.place), tuple(rest), setting)
    return Table({**table.entries, head: Entry(key, value)}, table.place)


def overridden(settings: Iterable[Setting], owner: str, params: Tree | None, place: Place) -> Tree | None:
    """`params` of an operator or nested graph with the `--set` words for it put in."""
    for setting in settings:
        if setting.owner != owner:
            continue
        setting.used = True
        if params is None or (isinstance(params, Leaf) and params.value is None):
            params = Table({}, place)
        if isinstance(params, Table):
            params = put(params, setting.path, setting)
    return params
