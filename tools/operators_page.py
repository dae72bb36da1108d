"""The reference page of the operators that come with this package, written from what they declare.

python tools/operators_page.py > docs/operators.md
"""

from __future__ import annotations

import importlib
import inspect
import json
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from dataflow.graph.catalogue import (
    BUILT_IN,
    Catalogue,
    discover,
    fires,
    input_notes,
    output_notes,
    parameter_notes,
    parameters,
)
from dataflow.messages.base import Message
from dataflow.operator import Operator

INTRODUCTION = """\
# Operators

<!-- Written by `python tools/operators_page.py > docs/operators.md`; change the operators, not this page. -->

The operators that come with this package. `dataflow operators` lists them in a terminal, `dataflow operators NAME`
describes one of them; both show the operators of other installed packages as well. How ports and firings work:
[writing an operator](writing-an-operator.md); how a graph names and wires operators: [graphs](graphs.md); the types:
[messages](messages.md).

An `In` makes the operator fire; a `Sampled` gives the newest message at that time, a `Batch` all since the last firing.
A source fires by itself: one that can wait (a dataset) is read as fast as the graph takes it, a device is not.
A parameter that `changes while running` can be set with `dataflow param set`.
"""

_KIND = {"in": "In", "sampled": "Sampled", "batch": "Batch"}
LONGEST = 90
"""Characters of a default that stand in the table as they are."""

GRAPHS_INTRODUCTION = """\
Files of `graphs/`; what stands in a nested graph is counted to the graphs that hold it, also where it is left out for
want of an input, or since what it makes is given. Operators that are not listed are sources of recordings and what
`PerceptionSystem` puts in place of sensors."""

GRAPHS = Path(__file__).resolve().parent.parent / "graphs"


def graphs_of(folder: Path = GRAPHS) -> dict[str, list[str]]:
    """The graph files directly in a folder by the operators (`module:Class`) in them, nested graphs included."""
    found: dict[str, list[str]] = {}
    for file in sorted(folder.glob("*.yaml")):
        for use in set(_uses(file)):
            found.setdefault(use, []).append(file.name)
    return dict(sorted(found.items()))


def _uses(file: Path, given: Mapping[str, Any] | None = None) -> Iterator[str]:
    """The operators of a file; one that a parameter names is that of the graph around it, else the parameter's own."""
    graph = YAML(typ="safe").load(file)
    values = {**graph.get("params", {}), **(given or {})}
    for operator in graph["operators"].values():
        use = re.sub(r"\$\{(\w+)\}", lambda name: str(values[name[1]]), operator["use"])
        if use.endswith(".yaml"):
            yield from _uses(file.parent / use, operator.get("params"))
        else:
            yield use


def markdown(catalogue: Catalogue) -> str:
    """The whole page for the operators of `catalogue`; modules that could not be imported are not on it."""
    groups: dict[str, dict[str, type[Operator]]] = {}
    for use, cls in catalogue.operators.items():
        groups.setdefault(use.partition(":")[0], {})[use] = cls
    contents = ["| operator | takes | gives | what it does |", "| --- | --- | --- | --- |"]
    contents += [_contents_row(cls) for group in groups.values() for cls in group.values()]
    parts = [INTRODUCTION, "\n".join(contents) + "\n", _table_of_graphs(catalogue)]
    for module, group in groups.items():
        parts.append(f"## {_title(module)}\n")
        parts += [section(use, cls) for use, cls in group.items()]
    return "\n".join(parts)


def _table_of_graphs(catalogue: Catalogue) -> str:
    """Which operator stands in which of the graphs that come with the project."""
    lines = ["## Which operator stands in which graph", "", GRAPHS_INTRODUCTION]
    lines += ["", "| operator | graphs |", "| --- | --- |"]
    for use, files in graphs_of().items():
        if use in catalogue.operators:
            name = catalogue.operators[use].spec.name
            graphs = ", ".join(f"[{Path(file).stem}](../graphs/{file})" for file in files)
            lines.append(f"| [{name}](#{name.lower()}) | {graphs} |")
    return "\n".join(lines) + "\n"


def section(use: str, cls: type[Operator]) -> str:
    """One operator: its documentation, when it fires, its ports and its parameters."""
    spec = cls.spec
    lines = [f"### {spec.name}", "", f"`use: {use}`", "", spec.doc, "", f"Fires {fires(cls)}.{_world(cls)}", ""]
    lines += ["| port | | type | meaning |", "| --- | --- | --- | --- |"]
    for port in spec.inputs.values():
        meaning = _meaning(port.doc, input_notes(port))
        lines.append(f"| `{port.name}` | {_KIND[port.kind]} | {_types(port.types)} | {meaning} |")
    for out in spec.outputs.values():
        lines.append(f"| `{out.name}` | Out | {_types(out.types)} | {_meaning(out.doc, output_notes(out))} |")
    rows = parameters(cls)
    if rows:
        lines += ["", "| parameter | type | default | meaning |", "| --- | --- | --- | --- |"]
        lines += [_parameter(row) for row in rows]
    return "\n".join(lines) + "\n"


def _title(module: str) -> str:
    """The first line of the module's documentation, as a heading."""
    doc = inspect.getdoc(importlib.import_module(module)) or module
    return doc.partition("\n")[0].removesuffix(".")


def _contents_row(cls: type[Operator]) -> str:
    spec = cls.spec
    takes = _distinct(t for port in spec.inputs.values() for t in _sorted(port.types))
    gives = _distinct(t for port in spec.outputs.values() for t in _sorted(port.types))
    summary = _cell(" ".join(spec.doc.partition("\n\n")[0].split()))
    return f"| [{spec.name}](#{spec.name.lower()}) | {takes} | {gives} | {summary} |"


def _sorted(types: Iterable[type[Message]]) -> list[type[Message]]:
    """Sorts the types of a port by name: Python may give a union in the order in which another module wrote it."""
    return sorted(types, key=lambda t: t.SCHEMA or "")


def _distinct(types: Iterable[type[Message]]) -> str:
    return ", ".join(dict.fromkeys(t.SCHEMA or "any message" for t in types))


def _types(types: Iterable[type[Message]]) -> str:
    return " or ".join(
        f"[{t.SCHEMA}](messages.md#{t.SCHEMA.lower()})" if t.SCHEMA else "any message" for t in _sorted(types)
    )


def _world(cls: type[Operator]) -> str:
    if cls.external:
        return " It touches the world: always recorded, never run again."
    return " It keeps no state." if cls.stateless else ""


def _meaning(doc: str, notes: list[str]) -> str:
    return _cell(f"{doc} ({'; '.join(notes)})" if notes and doc else doc or "; ".join(notes))


def _parameter(row: Mapping[str, Any]) -> str:
    unit = f" {row['unit']}" if row["unit"] else ""
    default = "must be given" if row["required"] else f"`{_cell(_short(row['default']))}`{unit}"
    meaning = _meaning(row["doc"], parameter_notes(row))
    return f"| `{row['name']}` | `{_cell(row['type'])}` | {default} | {meaning} |"


def _short(default: Any) -> str:
    """A default as JSON; of one that would fill its column, the first entry: `dataflow operators NAME` prints all."""
    text = json.dumps(default, ensure_ascii=False)
    if len(text) <= LONGEST or not isinstance(default, dict):
        return text
    name, value = next(iter(default.items()))
    return f"{{{json.dumps(name)}: {json.dumps(value, ensure_ascii=False)}, …}}"


def _cell(text: str) -> str:
    """Text that cannot end the cell of a table."""
    return " ".join(text.split()).replace("|", "\\|")


def main() -> int:
    """Writes the page; says on standard error which modules it lacks, and then fails."""
    found = discover(BUILT_IN)
    sys.stdout.write(markdown(found))
    for failure in found.failures:
        print(f"not on the page, because it cannot be imported: {failure}", file=sys.stderr)
    return 1 if found.failures else 0


if __name__ == "__main__":
    sys.exit(main())
