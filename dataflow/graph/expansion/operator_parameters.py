"""Parameters of one operator, validated by its class; faults are reported where they stand in the file."""

from __future__ import annotations

import re
from typing import Any

import pydantic

from dataflow.graph.problems import Place, Problems, did_you_mean, nearest
from dataflow.graph.yaml.tree import Leaf, Table, at, describe, plain, unknown
from dataflow.operator import Operator


def operator_parameters(
    full: str, cls: type[Operator], given: Table, place: Place, problems: Problems
) -> dict[str, Any]:
    """Returns the values of an operator's parameters as plain values; faults go to `problems`.

    `full`: the operator's name; `place`: where a parameter that is missing is reported.
    """
    known = {key: e for key, e in given.entries.items() if not unknown(e.value)}
    reported = given.entries.keys() - known.keys()
    try:
        values = cls.spec.parameters(**plain(Table(known, given.place)))
    except pydantic.ValidationError as error:
        for fault in error.errors():
            if fault["loc"][:1] not in {(name,) for name in reported}:
                _report(full, cls, fault, given, place, problems)
        return {}
    except Exception as error:  # a parameter type's own validator may raise anything
        problems.add(given.place, f"{full}: {type(error).__name__}: {error}")
        return {}
    return values.model_dump(mode="json")


def _report(full: str, cls: type[Operator], fault: Any, given: Table, place: Place, problems: Problems) -> None:
    fields = cls.spec.parameters.model_fields
    path = tuple(fault["loc"])
    name = ".".join(map(str, path))
    match fault["type"]:
        case "extra_forbidden" if len(path) == 1 and name in given.entries:
            hint = did_you_mean(name, fields, f"parameters of {cls.__name__}")
            key = given.entries[name].key.place
            problems.add(key, f"{full}: {cls.__name__} has no parameter {name!r}", hint)
        case "missing" if len(path) == 1:
            doc = fields[name].description or ""
            problems.add(place, f"{full}: parameter {name!r} must be given", f"{name}: {doc}")
        case _:
            value = at(given, path)
            message = str(fault["msg"]).removeprefix("Value error, ")
            message = message[:1].lower() + message[1:]
            if fault["type"].endswith("_parsing") or fault["type"] == "int_from_float":
                message = message.partition(", ")[0]  # what it got stands behind it anyway
            hint = f"{path[0]}: {fields[str(path[0])].description}" if path and str(path[0]) in fields else ""
            if fault["type"] == "string_type" and isinstance(value, Leaf) and not isinstance(value.value, str):
                hint = f"write '{value.raw}' in quotes"
            elif fault["type"] in ("literal_error", "enum") and isinstance(value, Leaf):
                near = nearest(str(value.value), re.findall(r"'([^']*)'", message))
                hint = f"did you mean {near!r}?" if near else hint
            said = value.raw if isinstance(value, Leaf) else describe(value)
            problems.add(value.place, f"{full}: parameter {name!r}: {message}, got {said}", hint)
