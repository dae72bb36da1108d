"""Lists the operators with what each declares: for `dataflow operators`, the docs and other tools."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import json
import pkgutil
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from typing import Any

from pydantic import BeforeValidator
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from dataflow.extras import missing_extra
from dataflow.graph.lookup import NotFound, find_operator, is_concrete, lost_exports, offered
from dataflow.graph.model import INPUT_CLASS, current_path
from dataflow.graph.problems import did_you_mean
from dataflow.operator import InputPort, Operator, OutputPort, is_source, is_tunable, state_hints
from dataflow.sync.stamps import format_duration, parse_duration

ENTRY_POINTS = "dataflow.operators"
"""The entry-point group by which a package advertises a module or package of operators."""
BUILT_IN = ("operators",)


@dataclass(frozen=True, slots=True)
class Failure:
    """A module that could not be imported, and why."""

    module: str
    reason: str
    mend: str = ""
    """The command that installs a missing package; "" where no extra brings it."""

    def __str__(self) -> str:
        return "; ".join(filter(None, (f"{self.module}: {self.reason}", self.mend)))


@dataclass(frozen=True, slots=True)
class Catalogue:
    """The operators found, by import path, and the modules that failed."""

    operators: Mapping[str, type[Operator]]
    failures: tuple[Failure, ...] = ()
    found_in: tuple[str, ...] = field(default=BUILT_IN)

    def to_json(self) -> dict[str, Any]:
        return {
            "operators": [CatalogueEntry(path, cls).to_json() for path, cls in self.operators.items()],
            "failures": [{"module": f.module, "reason": f.reason} for f in self.failures],
        }

    def failure_lines(self) -> Iterator[str]:
        """Yields a line for each failure; one for all operators that lack packages of the same extra."""
        lacking: dict[str, list[str]] = {}
        for failure in self.failures:
            if failure.mend:
                lacking.setdefault(failure.mend, []).append(failure.module.rpartition(":")[2])
            else:
                yield f"failed to import {failure}"
        for mend, names in lacking.items():
            yield f"{len(names)} not listed, since packages are missing; {mend}: {', '.join(names)}"


def discover(packages: Iterable[str] | None = None, named: str | None = None) -> Catalogue:
    """Imports the packages (built in and advertised, unless given) with all their modules and lists their operators.

    Of the built-in packages, only what they export is imported: they export all their operators, and their other
    modules (networks in training, say) take seconds. `named`: the class name of the only operators to list.
    A module that fails is reported in `failures` and the rest still listed. An operator has the path of the module
    that defines it, or of a package above that module which exports it, whichever is shorter.
    """
    roots = tuple(dict.fromkeys((*BUILT_IN, *_advertised()) if packages is None else packages))
    failures: list[Failure] = []
    found: dict[type[Operator], str] = {}
    for root in roots:
        for module in _modules(root, failures):
            if root in BUILT_IN and named is None:
                failures += (Failure(*told) for told in lost_exports(module))
            for name, value in offered(module, named):
                if not _is_own(value, root):
                    continue
                path = f"{module.__name__}:{name}"
                known = found.get(value)
                if known is None or len(path) < len(known):
                    found[value] = path
    paths = sorted((path, cls) for cls, path in found.items())
    return Catalogue(dict(paths), tuple(failures), roots)


def _advertised() -> list[str]:
    return sorted({entry.module for entry in entry_points(group=ENTRY_POINTS)})


def _is_own(value: type[Operator], root: str) -> bool:
    return (
        is_concrete(value)
        and not value.__name__.startswith("_")
        and (value.__module__ == root or value.__module__.startswith(f"{root}."))
    )


def _modules(root: str, failures: list[Failure]) -> Iterator[Any]:
    package = _import(root, failures)
    if package is None:
        return
    yield package
    built_in = root.partition(".")[0] in BUILT_IN
    for info in pkgutil.iter_modules(getattr(package, "__path__", [])):
        if info.ispkg or not (built_in or info.name == "__main__"):
            yield from _modules(f"{root}.{info.name}", failures)


def _import(name: str, failures: list[Failure]) -> Any:
    try:
        return importlib.import_module(name)
    except (Exception, SystemExit) as error:  # a module may fail in any way when it runs
        failures.append(Failure(name, f"{type(error).__name__}: {error}", missing_extra(error)))
        return None


@dataclass(frozen=True, slots=True)
class CatalogueEntry:
    """One operator and the path it is used by."""

    use: str
    operator: type[Operator]

    def to_json(self) -> dict[str, Any]:
        """All that the operator declares, as JSON values."""
        cls, spec = self.operator, self.operator.spec
        return {
            "use": self.use,
            "name": spec.name,
            "doc": spec.doc,
            "source": is_source(cls),
            "real_time": bool(getattr(cls, "real_time", False)),
            "external": cls.external,
            "stateless": cls.stateless,
            "fires": fires(cls),
            "inputs": [_input(port) for port in spec.inputs.values()],
            "outputs": [_output(port) for port in spec.outputs.values()],
            "params": [dict(row) for row in parameters(cls)],
            "state": state_fields(cls),
        }


def look_up(name: str) -> CatalogueEntry:
    """The operator of an import path or of a class name, as `find`; as few modules are imported as will do."""
    if ":" in name:
        return find(Catalogue({}), name)
    found = discover(named=name)
    return find(found if found.operators else discover(), name)


def find(catalogue: Catalogue, name: str) -> CatalogueEntry:
    """The operator of an import path or of a class name.

    A path outside the catalogue is imported. Raises LookupError that names the nearest operator, or all that fit.
    """
    operators = catalogue.operators
    fitting = [path for path in operators if path == name or path.endswith(f":{name}")]
    if len(fitting) == 1:
        return CatalogueEntry(fitting[0], operators[fitting[0]])
    if fitting:
        raise LookupError(f"several operators are called {name!r}: {', '.join(fitting)}")
    if ":" in name:
        found = find_operator(name)
        if not isinstance(found, NotFound):
            return CatalogueEntry(current_path(name), found)
        raise LookupError(f"{found.message}; {found.hint}" if found.hint else found.message)
    names = [path.partition(":")[2] for path in operators]
    hint = did_you_mean(name, names, "operators")
    failed = "".join(f"; {line}" for line in catalogue.failure_lines())
    raise LookupError(f"no operator {name!r}: {hint}{failed}")


def fires(cls: type[Operator]) -> str:
    """Returns when the operator fires, in words."""
    spec = cls.spec
    if is_source(cls):
        return "by itself (a device)" if getattr(cls, "real_time", False) else "by itself (can wait)"
    ways = []
    names = " and ".join(port.name for port in spec.triggers)
    if len(spec.triggers) > 1 and not spec.merge:
        window = f"within {format_duration(spec.tolerance)}" if spec.tolerance else "at equal stamps"
        ways.append(f"on {names} joined {window}")
    elif spec.triggers:
        ways.append(f"on every message of {names}")
    if spec.every is not None:
        ways.append(f"every {format_duration(spec.every)}")
    return ", and ".join(ways)


def _input(port: InputPort) -> dict[str, Any]:
    return {
        "name": port.name,
        "kind": port.kind,
        "types": [t.SCHEMA or "Message" for t in port.types],
        "many": port.many,
        "required": port.kind != "sampled" or port.required,
        "max_age": port.max_age,
        "before": port.before,
        "max": port.max,
        "doc": port.doc,
    }


def _output(port: OutputPort) -> dict[str, Any]:
    return {
        "name": port.name,
        "types": [t.SCHEMA or "Message" for t in port.types],
        "static": port.static,
        "lag": port.lag,
        "doc": port.doc,
    }


def parameters(cls: type[Operator]) -> list[Mapping[str, Any]]:
    """One row per parameter: name, type, default (None when required), bounds, unit, live, doc."""
    rows: list[Mapping[str, Any]] = []
    schema = cls.spec.parameters.model_json_schema()
    for name, info in cls.spec.parameters.model_fields.items():
        required = info.is_required()
        declared = schema["properties"].get(name, {})
        default = None if required or info.default is PydanticUndefined else declared.get("default")
        if _is_duration(info) and isinstance(default, int):
            default = format_duration(default)
        rows.append(
            {
                "name": name,
                "type": _type_text(info),
                "required": required,
                "default": default,
                "bounds": _bounds(declared),
                "unit": declared.get("unit", ""),
                "tunable": is_tunable(info),
                "doc": info.description or "",
            }
        )
    return rows


def state_fields(cls: type[Operator]) -> list[dict[str, Any]]:
    """One row per field of the state that the class declares: name, type, and whether a reset of the clock keeps it."""
    state = cls.spec.state
    if state is None:
        return []
    kept = {field.name for field in dataclasses.fields(state) if field.metadata.get("kept")}
    types = {name: re.sub(r"(\w+\.)+", "", inspect.formatannotation(hint)) for name, hint in state_hints(state).items()}
    return [{"name": name, "type": text, "kept": name in kept} for name, text in types.items()]


def _type_text(info: FieldInfo) -> str:
    if _is_duration(info):
        return "duration"
    annotation = info.annotation
    if isinstance(annotation, type) and not hasattr(annotation, "__args__"):
        return annotation.__name__
    return str(annotation).replace("typing.", "")


def _is_duration(info: FieldInfo) -> bool:
    return any(isinstance(mark, BeforeValidator) and mark.func is parse_duration for mark in info.metadata)


_BOUNDS = {
    "minimum": ">=",
    "exclusiveMinimum": ">",
    "maximum": "<=",
    "exclusiveMaximum": "<",
    "minLength": "length >=",
    "maxLength": "length <=",
    "minItems": "items >=",
    "maxItems": "items <=",
    "pattern": "matches",
}


def _bounds(declared: Mapping[str, Any]) -> str:
    return ", ".join(f"{word} {declared[key]}" for key, word in _BOUNDS.items() if key in declared)


def table(catalogue: Catalogue) -> RenderableType:
    """A table of all operators: path, what goes in and out, first line of the doc; failures below."""
    listed = Table(box=None, pad_edge=False, header_style="bold")
    listed.add_column("operator", no_wrap=True)
    for heading in ("in", "out", "what it does"):
        listed.add_column(heading, overflow="fold")
    for path, cls in catalogue.operators.items():
        spec = cls.spec
        takes = ", ".join(dict.fromkeys(p.type_text() for p in spec.inputs.values()))
        makes = ", ".join(dict.fromkeys(p.type_text() for p in spec.outputs.values()))
        listed.add_row(Text(path, "cyan"), Text(takes or "-"), Text(makes or "-"), Text(spec.doc.partition("\n")[0]))
    if not catalogue.failures:
        return listed
    return Group(listed, *(Text(line, "red") for line in catalogue.failure_lines()))


def page(described: CatalogueEntry) -> RenderableType:
    """One operator in full: doc, when it fires, ports, parameters and state."""
    cls, spec = described.operator, described.operator.spec
    parts: list[RenderableType] = [Text.assemble((spec.name, "bold"), "  ", (described.use, "cyan")), Text(spec.doc)]
    parts.append(Text(f"fires {fires(cls)}", "dim"))
    ports = _table("port", "kind", "type", "")
    for port in spec.inputs.values():
        ports.add_row(port.name, f"in  {INPUT_CLASS[port.kind]}", port.type_text(), _notes(input_notes(port), port.doc))
    for out in spec.outputs.values():
        ports.add_row(out.name, "out", out.type_text(), _notes(output_notes(out), out.doc))
    parts += [Text(), ports]
    rows = parameters(cls)
    if rows:
        table = _table("parameter", "type", "default", "")
        for row in rows:
            unit = f" {row['unit']}" if row["unit"] else ""
            default = "must be given" if row["required"] else json.dumps(row["default"], ensure_ascii=False) + unit
            table.add_row(row["name"], Text(row["type"]), Text(default), _notes(parameter_notes(row), row["doc"]))
        parts += [Text(), table]
    if fields := state_fields(cls):
        table = _table("state", "type", "")
        for row in fields:
            table.add_row(row["name"], Text(row["type"]), "kept by a reset of the clock" if row["kept"] else "")
        parts += [Text(), table]
    return Group(*parts)


def _table(*headings: str) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold")
    for heading in headings:
        table.add_column(heading, overflow="fold")
    return table


def _notes(notes: Sequence[str], doc: str) -> Text:
    return Text(f"{doc} ({'; '.join(notes)})" if notes and doc else doc or "; ".join(notes))


def input_notes(port: InputPort) -> list[str]:
    """Returns what is particular to an input, in a few words each."""
    notes = []
    if port.kind == "sampled" and not port.required:
        notes.append("optional")
    if port.many:
        notes.append("many streams")
    if port.before:
        notes.append("strictly before the firing" if port.before == 1 else f"{format_duration(port.before)} before")
    if port.max_age is not None:
        notes.append(f"at most {format_duration(port.max_age)} old")
    if port.max is not None:
        notes.append(f"at most {port.max}")
    return notes


def parameter_notes(row: Mapping[str, Any]) -> list[str]:
    """Returns what is particular to a parameter: its bounds, and whether it may change while the graph runs."""
    unit = "" if not row["unit"] or row["bounds"].startswith(("items", "length", "matches")) else f" {row['unit']}"
    notes = [row["bounds"] + unit] if row["bounds"] else []
    return [*notes, "changes while running"] if row["tunable"] else notes


def output_notes(port: OutputPort) -> list[str]:
    """Returns what is particular to an output, in a few words each."""
    notes = ["static"] if port.static else []
    return [*notes, f"up to {format_duration(port.lag)} late"] if port.lag else notes
