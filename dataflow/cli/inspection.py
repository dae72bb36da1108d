"""`dataflow check`, `show`, `operators`: what a graph and its operators are, without running anything."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dataflow.cli.execution import Json, Settings
from dataflow.cli.output import fail, friendly_errors, out, print_json


def check(
    graphs: Annotated[list[Path], typer.Argument(help="Graph files.")], settings: Settings = None, json: Json = False
) -> None:
    """Check graph files wholly: names, streams, types, parameters, cycles. Exit code 1 when one has faults.

    \b
    dataflow check graphs/*.yaml
    """
    from dataflow.graph import GraphError, Problem, load_graph

    faults: list[Problem] = []
    for path in graphs:
        with friendly_errors():
            try:
                graph = load_graph(path, settings=settings or ())
            except GraphError as error:
                faults += error.problems
                continue
        if not json:
            out.print(f"[green]ok[/] {path}: {len(graph.nodes)} operators, {len(graph.streams)} streams")
    if json:
        print_json(
            {
                "ok": not faults,
                "problems": [problem.to_json() for problem in faults],
            }
        )
    else:
        for problem in faults:
            out.print(str(problem), markup=False, soft_wrap=True)
    if faults:
        raise typer.Exit(1)


def show(
    graph: Annotated[Path, typer.Argument(help="The graph file.")],
    settings: Settings = None,
    mermaid: Annotated[bool, typer.Option("--mermaid", help="Print a Mermaid diagram instead.")] = False,
    svg: Annotated[Path | None, typer.Option("--svg", metavar="FILE", help="Write a picture.")] = None,
    json: Json = False,
) -> None:
    """Show a graph: hosts, operators, what each takes and makes.

    \b
    dataflow show graphs/synthetic_rgbd.yaml
    dataflow show graphs/synthetic_rgbd.yaml --svg graph.svg
    """
    from dataflow.graph import draw, load_graph

    with friendly_errors():
        loaded = load_graph(graph, settings=settings or ())
        if json:
            print_json(loaded.to_json())
        elif mermaid:
            print(draw.mermaid(loaded))
        elif svg is not None:
            svg.parent.mkdir(parents=True, exist_ok=True)
            svg.write_text(draw.svg(loaded), encoding="utf-8")
            out.print(f"wrote {svg}")
        else:
            out.print(draw.tree(loaded))


def operators(
    name: Annotated[str | None, typer.Argument(help="One operator: its ports, parameters and documentation.")] = None,
    json: Json = False,
) -> None:
    """List the operators that are installed, or describe one.

    \b
    dataflow operators
    dataflow operators CloudBuilder
    """
    from dataflow.graph import catalogue

    found = catalogue.discover()
    if name is None:
        if json:
            print_json(found.to_json())
        else:
            out.print(catalogue.table(found))
        return
    try:
        described = catalogue.find(found, name)
    except LookupError as error:
        raise fail(str(error.args[0])) from None
    if json:
        print_json(described.to_json())
    else:
        out.print(catalogue.page(described))
