"""`dataflow trigger`: a flight recorder keeps what was."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.markup import escape

from dataflow.cli.arguments import Json
from dataflow.cli.live import GraphName, Wait, running_graph
from dataflow.cli.output import friendly_errors, out, print_json, seconds


def trigger(
    text: Annotated[str, typer.Argument(metavar="TEXT", help="Why; it goes into the recording.")] = "somebody asked",
    graph: GraphName = None,
    wait: Wait = 0.0,
    json: Json = False,
) -> None:
    """Let the flight recorder of a running graph keep what was.

    A graph has one when it says `record: {keep: 60s, after: 10s}`, and runs without --record: the last 60 s lie in
    files that replace each other. What is kept lies in its folder (`folder:`, by default `flight`) a little after the
    time to record after it is over.

    Exit codes:

      0    asked
      2    no graph runs, or it has no flight recorder

    Examples:

      dataflow trigger
      dataflow trigger "nearly hit the door" --graph kitchen
    """
    from dataflow.client.attach import graph_of
    from dataflow.client.trigger import trigger as ask

    with friendly_errors():
        found = running_graph(graph, wait)
        ask(found, text)
        flight = graph_of(found).record.flight
        assert flight is not None
    if json:
        print_json({"graph": found.name, "text": text, "folder": flight.folder, "keep": flight.keep})
        return
    kept, after = seconds(flight.keep * 1e-9), seconds(flight.after * 1e-9)
    out.print(f"keeps the last {kept} and the next {after} in {escape(flight.folder)}", soft_wrap=True)
