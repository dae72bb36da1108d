"""`dataflow verify`: is this recording what the code makes of it?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dataflow.cli.execution import HostEach, Json, OneHost, Quiet, Settings
from dataflow.cli.output import DIFFERENT, count, err, fail, friendly_errors, out, print_json

if TYPE_CHECKING:
    from dataflow.runtime.verify import VerifyReport

_STYLE = {"identical": "green", "culprit": "bold red", "downstream": "yellow", "unverifiable": "yellow"}


def verify(
    recording: Annotated[Path, typer.Argument(help="The recording (.mcap), made with --record.")],
    graph: Annotated[
        Path | None, typer.Option("--graph", help="Another graph than the one that made the recording.")
    ] = None,
    settings: Settings = None,
    first: Annotated[
        str | None, typer.Option("--from", metavar="OPERATOR", help="Only this operator and what follows from it.")
    ] = None,
    only: Annotated[str | None, typer.Option("--only", metavar="OPERATOR", help="Only this operator.")] = None,
    one_host: OneHost = False,
    host_each: HostEach = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Re-execute a recorded run by its firing records and compare every output, digest by digest.

    Exit code 0: identical, 1: different or not wholly verifiable, 2: could not run.

    \b
    dataflow verify out/run.mcap
    dataflow verify out/run.mcap --only odometry --json
    """
    from dataflow.cli.progress import RunDisplay, shown
    from dataflow.graph import load_graph
    from dataflow.runtime.verify import verify as verify_recording

    with friendly_errors():
        if one_host and host_each:
            raise fail("--one-host and --host-each exclude each other")
        if graph is None and settings:
            raise fail("--set changes a graph file: name it with --graph")
        loaded = None if graph is None else load_graph(graph, settings=settings or ())
        placement: Any = "one_host" if one_host else "host_each" if host_each else "graph"
        with shown(err, RunDisplay(err), quiet=quiet or json) as watch:
            report = verify_recording(recording, graph=loaded, first=first, only=only, watch=watch, placement=placement)
    if json:
        print_json(report.as_json())
    else:
        _print(report)
    if not report.identical:
        raise typer.Exit(DIFFERENT)


def _print(report: VerifyReport) -> None:
    from rich.table import Table

    table = Table()
    table.add_column("operator")
    for name in ("firings", "repeated", "outputs", "differing"):
        table.add_column(name, justify="right")
    table.add_column("verdict")
    for v in report.operators:
        style = _STYLE[v.verdict]
        numbers = (v.firings, v.verified, v.outputs, v.differing)
        table.add_row(v.operator, *(count(n) for n in numbers), f"[{style}]{v.verdict}[/]")
    out.print(table)
    for v in report.operators:
        if v.first is not None:
            d = v.first
            port = f" port {d.port}" if d.port else ""
            out.print(f"  {v.operator}: first difference in firing {d.index} ({d.kind}) at stamp {d.stamp}{port}")
            out.print(f"    recorded {d.expected}\n    here     {d.got}", markup=False)
        if v.unverifiable:
            out.print(
                f"  {v.operator}: {v.unverifiable} firings could not be repeated (missing {v.missing or 'input'})"
            )
        if v.after_cut:
            out.print(f"  {v.operator}: {v.after_cut} messages lie after its last record")
        for file in v.files_changed:
            out.print(f"  {v.operator}: file {file} is not the one that was read then", markup=False)
    if not report.identical:
        for fact, then, now in report.facts:
            out.print(f"  [dim]{fact}: {then} when recorded, {now} here[/]")
    factor = f", {report.span / report.wall:.2f} × real time" if report.wall and report.span else ""
    if report.identical:
        out.print(f"[green]identical[/]: {count(report.messages)} messages, {report.streams} streams{factor}")
    elif report.culprits:
        out.print(f"[bold red]different[/]: look at {', '.join(report.culprits)}{factor}")
    else:
        out.print(f"[yellow]not wholly verified[/]{factor}")
