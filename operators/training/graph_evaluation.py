"""`dataflow evaluate graph`: runs a graph on data and prints what its metrics say, in one table."""

from __future__ import annotations

import json as jsonlib
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from dataflow.api.graphs import resolved
from dataflow.shipped import graph as shipped_graph
from operators.training.console import Json, fail, friendly, out_console

DATA_NAMES = ("data", "path", "folder", "file", "recording")
"""Parameters of a graph that `--data FOLDER` may mean."""
_SCORES = "operators.evaluation:"

Figures = Mapping[str, Mapping[str, Any]]
"""Figures that operators sum up at the end of a run, by operator and name."""


def evaluate_graph(
    graph: Annotated[
        Path,
        typer.Argument(
            help="A graph file, or a name that `dataflow graphs` lists: its metrics operators do the scoring."
        ),
    ],
    data: Annotated[
        list[str] | None,
        typer.Option(
            "--data",
            metavar="FOLDER|NAME=FOLDER|FILE.mcap",
            help="The data: sets the graph's parameter for it; a recording replaces the sources. May be repeated.",
        ),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Set a graph parameter, or OPERATOR.PARAM. May be repeated."),
    ] = None,
    everything: Annotated[
        bool, typer.Option("--all", help="What all operators count, not only the figures of metrics.")
    ] = False,
    json: Json = False,
) -> None:
    """Run a graph and print the figures of its metrics.

    `--data FOLDER` sets the parameter data, path, folder, file or recording, whichever the graph has; `--data
    NAME=FOLDER` one of another name. `--data FILE.mcap` replays a recording in place of the graph's sources. Metrics
    are the operators of operators.evaluation and your operators that give figures and have no outputs.

    Examples:

      dataflow evaluate graph graphs/lidar.yaml --data ../data/kitti_raw
      dataflow evaluate graph graphs/localize.yaml --set duration=20s --json

      dataflow evaluate graph perception --data recordings/demo.mcap
    """
    with friendly():
        graph = _file(graph)
        parameters = parameters_of(graph)
        recording, folders = recording_in(parameters, data or ())
        given = [*data_settings(parameters, folders), *(settings or ())]
    words = ["run", str(graph)] if recording is None else ["replay", str(recording), "--graph", str(graph)]
    command = [sys.executable, "-m", "dataflow.cli.main", *words, "--json", "--quiet"]
    ran = subprocess.run(
        [*command, *(word for one in given for word in ("--set", one))], stdout=subprocess.PIPE, text=True, check=False
    )
    if ran.returncode:
        raise typer.Exit(ran.returncode)  # the run has said why
    every = {name: summary for name, summary in jsonlib.loads(ran.stdout)["summaries"].items() if summary}
    figures = every if everything else {name: every[name] for name in metrics_of(graph, given) if name in every}
    if not figures:
        fail(f"no operator of {graph} gives figures: wire a metrics operator, such as operators.evaluation:...Metrics")
    if json:
        told = {"graph": str(graph), "settings": given, "figures": figures}
        typer.echo(jsonlib.dumps(told | ({} if recording is None else {"recording": str(recording)}), indent=2))
        return
    out_console.print(table_of(figures))


def recording_in(parameters: Mapping[str, Any], data: Sequence[str]) -> tuple[Path | None, list[str]]:
    """Returns the recording among what `--data` named, None where there is none, and the rest.

    A graph with a parameter `recording` is given it there. Raises ValueError for two, FileNotFoundError for one that is
    missing.
    """
    found = [entry for entry in data if entry.endswith(".mcap") and entry.partition("=")[0] not in parameters]
    if not found or "recording" in parameters:
        return None, list(data)
    if len(found) > 1:
        raise ValueError(f"--data names {len(found)} recordings ({', '.join(found)}); one takes the sources' place")
    if not Path(found[0]).is_file():
        raise FileNotFoundError(f"no recording {found[0]!r} (looked for {Path(found[0]).absolute()})")
    return Path(found[0]), [entry for entry in data if entry != found[0]]


def metrics_of(graph: Path, settings: Sequence[str]) -> list[str]:
    """Returns the names of the operators that score: those of operators.evaluation, and others without outputs."""
    nodes = resolved(graph, dict(one.split("=", 1) for one in settings)).nodes
    return [name for name, node in nodes.items() if node.use.startswith(_SCORES) or not node.outputs]


def _file(graph: Path) -> Path:
    """Returns a graph file that is there, or that comes with dataflow and has that name."""
    if graph.is_file():
        return graph
    shipped = shipped_graph(graph.as_posix().removeprefix("graphs/"))
    if shipped is None:
        raise FileNotFoundError(f"no graph file {str(graph)!r} (looked for {graph.absolute()})")
    return shipped.path


def parameters_of(graph: Path) -> Mapping[str, Any]:
    """Returns the parameters that a graph file declares. Raises ValueError for a file that is no YAML."""
    try:
        content = YAML(typ="safe").load(graph.read_text(encoding="utf-8"))
    except YAMLError as error:
        raise ValueError(f"{graph} is no YAML: {error}") from None
    found = content.get("params") if isinstance(content, Mapping) else None
    return found if isinstance(found, Mapping) else {}


def data_settings(parameters: Mapping[str, Any], data: Sequence[str]) -> list[str]:
    """Returns `NAME=FOLDER` for every `FOLDER` or `NAME=FOLDER`. Raises ValueError where no parameter is for it."""
    made = []
    for entry in data:
        name, equals, _ = entry.partition("=")
        if name in parameters and equals:
            made.append(entry)
            continue
        able, listed = [known for known in DATA_NAMES if known in parameters], ", ".join(parameters) or "none"
        if equals and name.isidentifier() and not Path(entry).exists():
            raise ValueError(f"--data {entry}: the graph has no parameter {name!r}; its parameters: {listed}")
        if len(able) != 1:
            which = f"both {' and '.join(able)}" if able else f"none of {', '.join(DATA_NAMES)}"
            raise ValueError(f"--data {entry}: the graph has {which}: say NAME={entry}; its parameters: {listed}")
        made.append(f"{able[0]}={entry}")
    return made


def table_of(figures: Figures) -> Table:
    """Returns a table of all figures by operator."""
    table = Table("operator", "figure", "value")
    for operator, summary in figures.items():
        for k, (name, value) in enumerate(summary.items()):
            shown = f"{value:.4g}" if isinstance(value, float) else escape(str(value))
            table.add_row(escape(operator) if k == 0 else "", escape(name), shown)
        table.add_section()
    return table
