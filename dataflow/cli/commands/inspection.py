"""`dataflow check`, `show`, `operators`, `messages`: graphs, operators and messages, without running anything."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from rich.padding import Padding
from rich.text import Text

from dataflow.cli.support.arguments import GraphFile, Json, ModuleFolders, Settings, find_modules_in, graph_file
from dataflow.cli.support.options import argument, option
from dataflow.cli.support.output import DIFFERENT, fail, out, plural, print_json, say, table
from dataflow.text import visible_lines

if TYPE_CHECKING:
    from dataflow.graph.catalogue import Catalogue
    from dataflow.messages import Message


def check(
    graphs: Annotated[list[Path], argument("GRAPH...", "Graph files (.yaml).")],
    settings: Settings = None,
    path: ModuleFolders = None,
    json: Json = False,
) -> None:
    """Check graph files wholly, without running them.

    Names, streams, types, parameters, cycles, processes. Exit code 0: all are sound; 1: one has faults; 2: one cannot
    be read.

    Examples:

      dataflow check graphs/*.yaml
      dataflow check graphs/rgbd_perception.yaml --set cloud.stride=8
    """
    from dataflow.graph import GraphError, Problem, load_graph

    faults: list[Problem] = []
    faulty = 0
    graphs = [graph_file(file) for file in graphs]
    find_modules_in(path)
    for file in graphs:
        try:
            graph = load_graph(file, settings=settings or ())
        except GraphError as error:
            faults += error.problems
            faulty += 1
            if not json:
                out.print(Text.assemble(("faults", "bold red"), f"  {file}: {plural(len(error.problems), 'fault')}"))
                out.print(Text(str(error)), soft_wrap=True)
            continue
        if not json:
            what = f"{plural(len(graph.nodes), 'operator')}, {plural(len(graph.streams), 'stream')}"
            out.print(Text.assemble(("ok", "green"), f"  {file}: {what}"), soft_wrap=True)
    if json:
        print_json({"ok": not faults, "problems": [problem.to_json() for problem in faults]})
    elif len(graphs) > 1 and faulty:
        say(f"{faulty} of {plural(len(graphs), 'graph')} cannot run")
    if faults:
        raise typer.Exit(DIFFERENT)


def show(
    graph: GraphFile,
    settings: Settings = None,
    path: ModuleFolders = None,
    mermaid: Annotated[bool, option("--mermaid", "Print a Mermaid flowchart.")] = False,
    json: Json = False,
) -> None:
    """Show a graph: processes, operators, what each takes and makes.

    Examples:

      dataflow show graphs/synthetic_rgbd.yaml
      dataflow show graphs/synthetic_rgbd.yaml --mermaid
      dataflow show graphs/synthetic_rgbd.yaml --json
    """
    from dataflow.graph import draw, load_graph

    if json and mermaid:
        raise fail("--json and --mermaid exclude each other")
    find_modules_in(path)
    loaded = load_graph(graph_file(graph), settings=settings or ())
    if json:
        print_json(loaded.to_json())
    elif mermaid:
        print(visible_lines(draw.mermaid(loaded)))
    else:
        out.print(draw.tree(loaded))


def operators(
    name: Annotated[str | None, argument("NAME", "One operator: its ports, parameters and documentation.")] = None,
    path: ModuleFolders = None,
    json: Json = False,
) -> None:
    """List the operators that are installed, or describe one.

    Examples:

      dataflow operators
      dataflow operators CloudBuilder
      dataflow operators operators.cloud:CloudBuilder --json
    """
    from dataflow.graph import catalogue

    find_modules_in(path)
    if name is None:
        found = catalogue.discover()
        if json:
            print_json(found.to_json())
        else:
            _print_operators(found)
        return
    try:
        described = catalogue.look_up(name)
    except LookupError as error:
        raise fail(str(error.args[0])) from None
    if json:
        print_json(described.to_json())
    else:
        out.print(catalogue.page(described))


def _print_operators(found: Catalogue) -> None:
    """One operator after the other: path, what goes in and out, first sentence of its documentation."""
    for path, operator in found.operators.items():
        spec = operator.spec
        takes = ", ".join(dict.fromkeys(p.type_text() for p in spec.inputs.values()))
        makes = ", ".join(dict.fromkeys(p.type_text() for p in spec.outputs.values()))
        out.print(Text(path, style="bold cyan"), soft_wrap=True)
        flow = f"{takes} → {makes}" if takes and makes else f"source of {makes}" if makes else f"sink of {takes}"
        out.print(Padding(Text(flow, style="dim"), (0, 0, 0, 4)))
        out.print(Padding(Text(spec.doc.partition("\n\n")[0].replace("\n", " ")), (0, 0, 0, 4)))
    for line in found.failure_lines():
        say(f"[red]{escape(line)}[/]")


def messages(
    name: Annotated[str | None, argument("TYPE", "One type: its fields, units and shapes.")] = None,
    path: ModuleFolders = None,
    json: Json = False,
) -> None:
    """List the types of messages, or describe one: fields, units, shapes, and the ROS types that it is read from.

    Exit codes:

      0    printed
      2    there is no such type

    Examples:

      dataflow messages
      dataflow messages Odometry
      dataflow messages PointCloud --json
    """
    from dataflow.messages import message_types

    find_modules_in(path)
    types = dict(sorted(message_types().items()))
    if name is None:
        if json:
            print_json({schema: _first_line(kind) for schema, kind in types.items()})
            return
        made = table("type", "what it is")
        for schema, kind in types.items():
            made.add_row(Text(schema), Text(_first_line(kind)))
        out.print(made)
        return
    if name not in types:
        close = [schema for schema in types if name.lower() in schema.lower() or schema.lower() in name.lower()]
        raise fail(f"there is no message type {name!r}; there are {', '.join(close or types)}")
    described = _described(types[name])
    if json:
        print_json(described)
        return
    out.print(Text(name, style="bold cyan"))
    out.print(Text(described["doc"]))
    made = table("field", "type", "unit", "what it holds")
    for field in described["fields"]:
        made.add_row(*map(Text, (field["name"], field["type"], field["unit"], field["doc"])))
    out.print(made)
    if described["ros"]:
        out.print(Text(f"read from {', '.join(described['ros'])}", style="dim"))


def _first_line(kind: type[Message]) -> str:
    return (inspect.getdoc(kind) or "").partition("\n\n")[0].replace("\n", " ")


def _described(kind: type[Message]) -> dict[str, Any]:
    """JSON values: the documentation, the fields with the stamp first, and the ROS types that usually become it."""
    from dataflow.interop.ros import CONVERSIONS
    from dataflow.messages.base import ArrayField

    stamp = {"name": "stamp", "type": "int", "unit": "ns", "optional": False, "doc": "event time since the epoch"}
    fields = [stamp]
    for field in kind.FIELDS:
        form = f"{field.dtype_text()} {field.shape_text()}" if isinstance(field, ArrayField) else field.kind
        fields.append(
            {
                "name": field.name,
                "type": form + (" | None" if field.optional else ""),
                "unit": field.unit if isinstance(field, ArrayField) else "",
                "optional": field.optional,
                "doc": field.doc,
            }
        )
    ros = [name.replace("/msg/", "/") for name, (becomes, _) in CONVERSIONS.items() if becomes is kind]
    return {"type": kind.SCHEMA, "doc": inspect.getdoc(kind) or "", "fields": fields, "ros": ros}
