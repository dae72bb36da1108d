"""`dataflow run` and `dataflow replay`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dataflow.cli.output import INTERRUPTED, err, fail, friendly_errors, out, print_json

if TYPE_CHECKING:
    from dataflow.graph import Graph
    from dataflow.runtime.supervisor import RunReport

Settings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NAME=VALUE", help="Set a graph parameter, or OPERATOR.PARAM. May be repeated."),
]
OneHost = Annotated[bool, typer.Option("--one-host", help="Run all operators in one process.")]
HostEach = Annotated[bool, typer.Option("--host-each", help="Run every operator in a process of its own.")]
Place = Annotated[
    list[str] | None,
    typer.Option("--place", metavar="OPERATOR=HOST", help="Run OPERATOR in the process HOST. May be repeated."),
]
Record = Annotated[
    Path | None, typer.Option("--record", metavar="FILE.mcap", help="Record the graph's streams and firings.")
]
View = Annotated[
    str | None,
    typer.Option(
        "--view",
        metavar="spawn|serve|FILE.rrd",
        help="Open the viewer, serve it to a browser, or save everything to a file.",
    ),
]
Rate = Annotated[
    float | None, typer.Option("--rate", min=1e-6, help="Pace: 1 is real time. Default: as fast as the graph goes.")
]
Paranoid = Annotated[bool, typer.Option("--paranoid", help="Catch operators that write into their inputs.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace the recording if it exists.")]
Json = Annotated[bool, typer.Option("--json", help="Print the report, digests included, as JSON.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress display.")]


def run(
    graph: Annotated[Path, typer.Argument(help="The graph file.")],
    settings: Settings = None,
    one_host: OneHost = False,
    host_each: HostEach = False,
    place: Place = None,
    record: Record = None,
    overwrite: Overwrite = False,
    view: View = None,
    rate: Rate = None,
    paranoid: Paranoid = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Run a graph file.

    \b
    dataflow run graphs/synthetic_rgbd.yaml
    dataflow run graphs/rgbd_perception.yaml --set data=PATH --record out/run.mcap --view spawn
    dataflow run graphs/synthetic_rgbd.yaml --host-each --rate 1
    """
    from dataflow.graph import load_graph
    from dataflow.runtime.execute import run as run_graph

    with friendly_errors():
        loaded = load_graph(graph, settings=settings or ())
        options = _options(loaded, one_host, host_each, place, record, overwrite, view, rate, paranoid)
        _execute(
            lambda watch: run_graph(loaded, watch=watch, **options), loaded, view, None, json=json, quiet=quiet or json
        )


def replay(
    recording: Annotated[Path, typer.Argument(help="The recording (.mcap).")],
    graph: Annotated[
        Path | None, typer.Option("--graph", help="Another graph than the one that made the recording.")
    ] = None,
    settings: Settings = None,
    start: Annotated[float | None, typer.Option(min=0, help="Seconds from the first message.")] = None,
    end: Annotated[float | None, typer.Option(min=0, help="Seconds from the first message.")] = None,
    one_host: OneHost = False,
    host_each: HostEach = False,
    place: Place = None,
    record: Record = None,
    overwrite: Overwrite = False,
    view: View = None,
    rate: Rate = None,
    paranoid: Paranoid = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Replay a recording: recorded streams replace the sources, everything else runs again, with identical results.

    \b
    dataflow replay recordings/demo.mcap
    dataflow replay out/run.mcap --graph graphs/other.yaml --record out/again.mcap
    dataflow replay out/run.mcap --start 5 --end 10 --rate 1 --view spawn
    """
    from dataflow.graph import load_graph
    from dataflow.recording import Recording
    from dataflow.runtime.execute import replay as replay_recording
    from dataflow.runtime.replay import plan_replay, recorded_graph

    with friendly_errors():
        if record is not None and record.exists() and record.resolve() == recording.resolve():
            raise fail(f"--record {record} is the recording that is being replayed; name another file")
        with Recording(recording) as opened:
            if graph is None and settings:
                raise fail("--set changes a graph file: name it with --graph")
            loaded = recorded_graph(opened) if graph is None else load_graph(graph, settings=settings or ())
            log = plan_replay(opened, loaded, start=start, end=end)
            infos = [opened.streams[s] for s in log.streams if not opened.streams[s].static]
        first = max(min((i.first for i in infos if i.first is not None), default=0), log.start or 0)
        last = max((i.last for i in infos if i.last is not None), default=0)
        span = (first, last if log.end is None else min(last, log.end))
        options = _options(loaded, one_host, host_each, place, record, overwrite, view, rate, paranoid)
        _execute(
            lambda watch: replay_recording(recording, graph=loaded, start=start, end=end, watch=watch, **options),
            loaded,
            view,
            span,
            json=json,
            quiet=quiet or json,
        )


def _options(
    graph: Graph,
    one_host: bool,
    host_each: bool,
    place: list[str] | None,
    record: Path | None,
    overwrite: bool,
    view: str | None,
    rate: float | None,
    paranoid: bool,
) -> dict[str, Any]:
    if one_host + host_each + bool(place) > 1:
        raise fail("--one-host, --host-each and --place exclude each other")
    placement: Any = "one_host" if one_host else "host_each" if host_each else "graph"
    if place:
        placement = {}
        for word in place:
            operator, separator, host = word.partition("=")
            if not separator or not host or operator not in graph.nodes:
                known = ", ".join(graph.nodes)
                raise fail(f"--place {word!r}: expected OPERATOR=HOST with an operator of the graph ({known})")
            placement[operator] = host
    if record is not None and record.exists() and not overwrite:
        raise fail(f"{record} exists; name another file, or replace it with --overwrite")
    if view is not None and view not in ("spawn", "serve") and not view.endswith(".rrd"):
        raise fail(f"--view {view!r}: expected spawn, serve, or a file that ends in .rrd")
    return {
        "placement": placement,
        "record": record,
        "overwrite": overwrite,
        "view_file": Path(view) if view is not None and view.endswith(".rrd") else None,
        "rate": rate,
        "paranoid": paranoid,
    }


def _execute(
    start: Any, graph: Graph, view: str | None, span: tuple[int, int] | None, *, json: bool, quiet: bool
) -> None:
    from dataflow.cli.progress import RunDisplay, print_report, report_json, shown
    from dataflow.runtime.attach import attached_viewer

    display = RunDisplay(err, span=span)
    target = view if view in ("spawn", "serve") else None
    with attached_viewer(graph.name, target), shown(err, display, quiet=quiet) as watch:
        report: RunReport = start(watch)
    if json:
        print_json(report_json(report))
    else:
        print_report(out, report)
    if report.interrupted:
        raise typer.Exit(INTERRUPTED)


