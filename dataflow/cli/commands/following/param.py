"""`dataflow param`: the parameters of a graph that runs."""

from __future__ import annotations

import json as json_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from rich.markup import escape
from rich.text import Text

from dataflow.cli.commands.following.live import THE_ONLY, Running
from dataflow.cli.support.arguments import Json, OutInstead, existing, find_modules_in, named_once
from dataflow.cli.support.options import argument, option
from dataflow.cli.support.output import DIFFERENT, fail, out, print_json, print_json_line, say, table
from dataflow.text import jsonable

if TYPE_CHECKING:
    from dataflow.client.processes import Parameter
    from dataflow.graph import Graph

Timeout = Annotated[float, option("--timeout SECONDS", "Wait so long for an answer.")]


def set_(
    parameter: Annotated[str, argument("OPERATOR.NAME", "Such as detector.score_threshold.")],
    value: Annotated[str, argument("VALUE", "A YAML value: 0.3, true, near, [1, 2].")],
    which: Running = THE_ONLY,
    timeout: Timeout = 5.0,
    json: Json = False,
) -> None:
    """Change a parameter of an operator that runs.

    It changes between two firings; the value that the operator took is printed. The change stands in the recording at
    its place, and `verify` repeats it there. `dataflow param list` shows which parameters can change.

    Exit codes: 0 changed; 1 refused (no such parameter, a value that it cannot take), or no answer; 2 no such
    graph or operator.

    Examples:

      dataflow param set detector.score_threshold 0.5
      dataflow param set front/cloud.stride 4 --graph two_cameras
    """
    from dataflow.client.processes import processes_of

    _check(timeout)
    found = which.found()
    operator, name = _split(parameter, _graph(found))
    if not name:
        raise fail(f"{parameter!r} names no parameter: write {operator}.NAME")
    wanted = _value(value)
    with processes_of(found) as processes:
        taken = processes.set_parameter(operator, name, wanted, timeout)
    if json:
        print_json({"operator": operator, "name": name, "value": taken})
    else:
        out.print(Text(f"{operator}.{name} = {_text(taken)}"), soft_wrap=True)


def get(
    parameter: Annotated[str | None, argument("OPERATOR[.NAME]", "One parameter, or all of an operator.")] = None,
    which: Running = THE_ONLY,
    timeout: Timeout = 5.0,
    json: Json = False,
) -> None:
    """Print the values that parameters have now.

    Exit codes: 0 all answered; 1 an operator did not; 2 no such graph, operator or parameter.

    Examples:

      dataflow param get
      dataflow param get cloud
      dataflow param get cloud.stride
    """
    from dataflow.graph.problems import did_you_mean

    operators, name, values = _asked(parameter, which, timeout)
    if name:
        for operator, parameters in values.items():
            if name not in parameters:
                known = did_you_mean(name, parameters, "its parameters")
                raise fail(f"{operator!r} has no parameter {name!r}: {known}")
            shown = parameters[name].value
            if json:
                print_json_line(shown)
            else:
                out.print(Text(_text(shown)), soft_wrap=True)
    elif json:
        print_json({op: {n: p.value for n, p in parameters.items()} for op, parameters in values.items()})
    else:
        for operator, parameters in values.items():
            for n, p in parameters.items():
                out.print(Text.assemble(f"{operator}.{n}  ", (_text(p.value), "bold")), soft_wrap=True)
    _say_who_is_missing(operators, values, timeout)


def list_(
    every: Annotated[bool, option("--all", "Also those that cannot change while the graph runs.")] = False,
    which: Running = THE_ONLY,
    timeout: Timeout = 5.0,
    json: Json = False,
) -> None:
    """List the parameters that can change while the graph runs, with their values and bounds.

    Examples:

      dataflow param list
      dataflow param list --all --json
    """
    found = which.found()
    resolved = _graph(found)
    operators, _, values = _asked(None, which, timeout)
    rows = [
        {"parameter": f"{op}.{name}", "value": p.value, "tunable": p.tunable, **_declared(resolved, op, name)}
        for op, parameters in values.items()
        for name, p in parameters.items()
        if p.tunable or every
    ]
    if json:
        print_json(rows)
    elif rows:
        shown = table("parameter", "value", *(("changes while running",) if every else ()), "bounds", "meaning")
        for row in rows:
            cells = [row["parameter"], _text(row["value"]), *((("yes" if row["tunable"] else ""),) if every else ())]
            shown.add_row(*(Text(cell) for cell in (*cells, row["bounds"], row["doc"])))
        out.print(shown)
    else:
        say(f"no parameter of {escape(found.name)} can change while it runs")
    _say_who_is_missing(operators, values, timeout)


def dump(
    file: Annotated[Path | None, argument("FILE", "A YAML file to write. Default: print it.")] = None,
    out_option: OutInstead = None,
    every: Annotated[bool, option("--all", "Also those that cannot change while the graph runs.")] = False,
    overwrite: Annotated[bool, option("--overwrite", "Replace a file that exists.")] = False,
    which: Running = THE_ONLY,
    timeout: Timeout = 5.0,
) -> None:
    """Write the values that parameters have now as YAML: operator, name, value. `param load` sets them again.

    Exit codes: 0 all answered; 1 an operator did not; 2 no such graph.

    Examples:

      dataflow param dump
      dataflow param dump tuned.yaml
    """
    file = named_once("FILE", file, out_option)
    if file is not None and file.exists() and not overwrite:
        raise fail(f"{file} exists; name another file, or replace it with --overwrite")
    operators, _, values = _asked(None, which, timeout)
    lines: list[str] = []
    for operator, parameters in values.items():
        shown = {name: p.value for name, p in parameters.items() if p.tunable or every}
        if shown:
            lines.append(f"{json_module.dumps(operator, ensure_ascii=False)}:")
            lines += [f"  {n}: {json_module.dumps(jsonable(v), ensure_ascii=False)}" for n, v in shown.items()]
    text = "\n".join(lines) + "\n" if lines else "{}\n"
    if file is None:
        out.print(Text(text), end="", soft_wrap=True)
    else:
        file.write_text(text, encoding="utf-8")
    _say_who_is_missing(operators, values, timeout)


def load(
    file: Annotated[Path, argument("FILE", "YAML as `param dump` writes it.")],
    which: Running = THE_ONLY,
    timeout: Timeout = 5.0,
) -> None:
    """Set the parameters that a file names, as far as their values differ.

    Names are checked before anything is changed. It stops at the first value that is refused.

    Exit codes: 0 all set; 1 refused, or no answer; 2 no such file, graph, operator or parameter.

    Examples:

      dataflow param load tuned.yaml
    """
    from dataflow.client.processes import processes_of
    from dataflow.graph.problems import did_you_mean

    wanted = _read_values(existing(file, "a YAML file of parameters"))
    found = which.found()
    for operator in wanted:
        _split(operator, _graph(found))
    _check(timeout)
    with processes_of(found) as processes:
        present = processes.parameters(list(wanted), timeout)
        _say_who_is_missing(list(wanted), present, timeout)
        changes = []
        for operator, values in wanted.items():
            for name, value in values.items():
                if name not in present[operator]:
                    known = did_you_mean(name, present[operator], "its parameters")
                    raise fail(f"{file}: {operator!r} has no parameter {name!r}: {known}")
                if jsonable(present[operator][name].value) != value:
                    changes.append((operator, name, value))
        for operator, name, value in changes:
            taken = processes.set_parameter(operator, name, value, timeout)
            out.print(Text(f"{operator}.{name} = {_text(taken)}"), soft_wrap=True)
    if not changes:
        say("every parameter has the value of the file already")


def _read_values(file: Path) -> dict[str, dict[str, Any]]:
    """Values by operator and parameter."""
    values = _value(file.read_text(encoding="utf-8"), str(file))
    if not isinstance(values, dict) or not all(isinstance(v, dict) for v in values.values()):
        raise fail(f"{file}: expected a mapping from operators to their parameters, as `param dump` writes it")
    return values


def _check(timeout: float) -> None:
    if not 0 < timeout < 1e6:
        raise fail(f"--timeout {timeout:g}: expected seconds, more than 0")


def _graph(found: Any) -> Graph:
    from dataflow.client.attach import graph_of

    return graph_of(found)


def _split(word: str, graph: Graph) -> tuple[str, str]:
    """The operator and the parameter that are meant. The names of operators hold no dot."""
    from dataflow.graph.problems import did_you_mean

    operator, _, name = word.partition(".")
    if operator not in graph.nodes:
        raise fail(f"no operator {operator!r} runs: {did_you_mean(operator, graph.nodes, 'there are')}")
    return operator, name


def _value(text: str, shown: str = "") -> Any:
    """The YAML value of a text; `shown` is how errors call it, by default the text itself."""
    import msgpack
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        value = YAML(typ="safe", pure=True).load(text)
    except (YAMLError, ValueError) as error:
        raise fail(f"{shown or repr(text)} is no YAML value: {str(error).splitlines()[0]}") from None
    try:
        msgpack.packb(value)
    except (TypeError, ValueError, OverflowError):
        raise fail(
            f"{shown or repr(text)} cannot be the value of a parameter: expected a text, true, false, a number of at "
            "most 64 bits, or a list or mapping of these"
        ) from None
    return value


def _asked(word: str | None, which: Running, timeout: float) -> tuple[list[str], str, dict[str, dict[str, Parameter]]]:
    """The operators that were asked, the parameter (or none), and what they answered."""
    from dataflow.client.processes import processes_of

    _check(timeout)
    found = which.found()
    graph = _graph(found)
    operator, parameter = ("", "") if word is None else _split(word, graph)
    operators = [operator] if operator else list(graph.nodes)
    with processes_of(found) as processes:
        return operators, parameter, processes.parameters(operators, timeout)


def _say_who_is_missing(operators: list[str], values: dict[str, Any], timeout: float) -> None:
    missing = [op for op in operators if op not in values]
    if missing:
        raise fail(f"no answer for {', '.join(missing)} within {timeout:g} s", code=DIFFERENT)


def _declared(graph: Graph, operator: str, name: str) -> dict[str, str]:
    """Bounds and meaning of a parameter; empty where its class cannot be imported here."""
    from dataflow.graph.catalogue import parameters
    from dataflow.graph.model import OperatorImportError

    find_modules_in(None)
    try:
        rows = parameters(graph.nodes[operator].operator)
    except OperatorImportError:
        return {"bounds": "", "doc": ""}
    row = next((row for row in rows if row["name"] == name), {"bounds": "", "unit": "", "doc": ""})
    bounds = row["bounds"] + (f" {row['unit']}" if row["bounds"] and row["unit"] else "")
    return {"bounds": bounds, "doc": row["doc"]}


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json_module.dumps(jsonable(value), ensure_ascii=False)
