"""`dataflow verify`: is this recording what the code makes of it?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.text import Text

from dataflow.cli.arguments import Json, RecordingFile, Settings, existing
from dataflow.cli.execution import HostEach, OneHost, Quiet
from dataflow.cli.output import (
    DIFFERENT,
    count,
    err,
    fail,
    friendly_errors,
    out,
    plural,
    print_json,
    seconds,
    table,
)

if TYPE_CHECKING:
    from dataflow.runtime.reexecute import Verification
    from dataflow.runtime.verify import VerifyReport

_STYLE = {"identical": "green", "culprit": "bold red", "downstream": "yellow", "unverifiable": "yellow"}


def verify(
    recording: RecordingFile,
    graph: Annotated[
        Path | None,
        typer.Option("--graph", metavar="GRAPH", help="Another graph than the one that made the recording."),
    ] = None,
    settings: Settings = None,
    first: Annotated[
        str | None, typer.Option("--from", metavar="OPERATOR", help="Only this operator and what follows from it.")
    ] = None,
    only: Annotated[str | None, typer.Option("--only", metavar="OPERATOR", help="Only this operator.")] = None,
    quiet: Quiet = False,
    one_host: OneHost = False,
    host_each: HostEach = False,
    json: Json = False,
) -> None:
    """Re-execute a recorded run by its firing records, and compare every output.

    Outputs are compared digest by digest. Where they differ, the culprit (same inputs, other output) is told from what
    only follows from it. Exit code 0: identical; 1: different, or not wholly verifiable; 2: could not run.

    Examples:

      dataflow verify run.mcap
      dataflow verify run.mcap --only odometry --json
      dataflow verify run.mcap --from odometry --graph changed.yaml
    """
    from dataflow.cli.progress import RunDisplay, shown
    from dataflow.graph import load_graph
    from dataflow.runtime.verify import verify as verify_recording

    with friendly_errors():
        existing(recording, "a recording")
        if one_host and host_each:
            raise fail("--one-host and --host-each exclude each other")
        if first is not None and only is not None:
            raise fail("--from and --only exclude each other")
        if graph is None and settings:
            raise fail("--set changes a graph file: name it with --graph")
        loaded = None if graph is None else load_graph(existing(graph, "a graph file"), settings=settings or ())
        placement: Any = "one_host" if one_host else "host_each" if host_each else "graph"
        with shown(err, RunDisplay(err), quiet=quiet) as watch:
            report = verify_recording(recording, graph=loaded, first=first, only=only, watch=watch, placement=placement)
    if json:
        print_json(report.as_json())
    else:
        _print(report)
    if not report.identical:
        raise typer.Exit(DIFFERENT)


def _print(report: VerifyReport) -> None:
    numbers = ("firings", "repeated", "outputs", "differing")
    verdicts = table("operator", *numbers, "verdict", right=numbers)
    for v in report.operators:
        cells = (count(n) for n in (v.firings, v.verified, v.outputs, v.differing))
        verdicts.add_row(Text(v.operator), *cells, Text(v.verdict, style=_STYLE[v.verdict]))
    out.print(verdicts)
    for v in report.operators:
        for line in _remarks(v):
            out.print(Text(line), soft_wrap=True)
    if not report.identical:
        for fact, then, now in report.facts:
            out.print(Text(f"{fact}: {then} when recorded, {now} here", style="dim"), soft_wrap=True)
    pace = f", {seconds(report.span)} of event time in {seconds(report.wall)}" if report.wall and report.span else ""
    if report.identical:
        what = f"{plural(report.messages, 'message')} of {plural(report.streams, 'stream')}"
        out.print(Text.assemble(("identical", "green"), f": {what}{pace}"))
    elif report.culprits:
        out.print(Text.assemble(("different", "bold red"), f": look at {', '.join(report.culprits)}{pace}"))
    else:
        out.print(Text.assemble(("not wholly verified", "yellow"), pace))


def _remarks(v: Verification) -> list[str]:
    """What there is to say about one operator, besides its row."""
    lines = []
    if v.first is not None:
        d = v.first
        port = f" port {d.port}" if d.port else ""
        lines.append(f"{v.operator}: first difference in firing {d.index} ({d.kind}) at stamp {d.stamp}{port}")
        lines += [f"  recorded  {d.expected}", f"  here      {d.got}"]
    if v.unverifiable:
        what = plural(v.unverifiable, "firing")
        lines.append(f"{v.operator}: {what} could not be repeated (missing {v.missing or 'input'})")
    if v.after_cut:
        lines.append(f"{v.operator}: {plural(v.after_cut, 'message')} after its last record")
    lines += [f"{v.operator}: file {file} is not the one that was read then" for file in v.files_changed]
    return lines
