"""`dataflow messages`: the types of messages, and the fields of one."""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.text import Text

from dataflow.cli.arguments import Json, ModuleFolders, find_modules_in
from dataflow.cli.output import fail, friendly_errors, out, print_json, table

if TYPE_CHECKING:
    from dataflow.messages import Message


def messages(
    name: Annotated[str | None, typer.Argument(metavar="TYPE", help="One type: its fields, units and shapes.")] = None,
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

    with friendly_errors():
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
