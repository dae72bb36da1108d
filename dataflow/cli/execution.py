"""`dataflow run` and `dataflow replay`."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from dataflow.cli.arguments import (
    FLAG,
    End,
    GraphFile,
    ModuleFolders,
    Network,
    RecordingFile,
    Settings,
    Start,
    existing,
    find_modules_in,
    number,
    output_file,
    span,
    window,
)
from dataflow.cli.output import DIFFERENT, INTERRUPTED, err, fail, friendly_errors, out, print_json, say, size

if TYPE_CHECKING:
    from dataflow.graph import Graph
    from dataflow.recording import Recording
    from dataflow.supervision.report import RunReport
    from dataflow.supervision.run import Watch

_PLACEMENT, _OUTPUT = "Placement", "Results"

OneProcess = Annotated[
    bool,
    typer.Option("--one-process", metavar=FLAG, rich_help_panel=_PLACEMENT, help="Run all operators in one process."),
]
ProcessEach = Annotated[
    bool,
    typer.Option(
        "--process-each", metavar=FLAG, rich_help_panel=_PLACEMENT, help="Run every operator in a process of its own."
    ),
]
Place = Annotated[
    list[str] | None,
    typer.Option(
        "--place",
        metavar="OPERATOR=PROCESS",
        rich_help_panel=_PLACEMENT,
        help="Run OPERATOR in the process of that name. May be repeated.",
    ),
]
Record = Annotated[
    Path | None,
    typer.Option(
        "--record", metavar="FILE.mcap", rich_help_panel=_OUTPUT, help="Record the graph's streams and firings."
    ),
]
View = Annotated[
    str | None,
    typer.Option(
        "--view",
        metavar="TARGET",
        rich_help_panel=_OUTPUT,
        help="spawn: a viewer window; serve: a page for a browser; FILE.rrd: save everything that is shown.",
    ),
]
Open = Annotated[
    bool,
    typer.Option(
        "--open",
        metavar=FLAG,
        rich_help_panel=_OUTPUT,
        help="With --view FILE.rrd: open the saved file in the viewer when there is a display.",
    ),
]
Replace = Annotated[
    bool,
    typer.Option("--overwrite", metavar=FLAG, rich_help_panel=_OUTPUT, help="Replace output files that exist."),
]
Json = Annotated[
    bool,
    typer.Option("--json", metavar=FLAG, rich_help_panel=_OUTPUT, help="Print the report, digests included, as JSON."),
]
Rate = Annotated[
    float | None,
    typer.Option(
        "--rate",
        metavar="RATE",
        parser=number(0.001, 1000, "1 is real time"),
        help="Pace: 1 is real time. Default: as fast as the graph goes.",
    ),
]
Timeout = Annotated[
    float,
    typer.Option(
        "--timeout",
        metavar="SECONDS",
        parser=number(0.1, 1e6, "seconds"),
        help="Give up after so long without any progress, and when the operators take longer to be set up.",
    ),
]
Live = Annotated[
    bool,
    typer.Option(
        "--live",
        metavar=FLAG,
        help="Time does not wait: sources run by the clock, and operators that are too slow drop messages as their "
        "`live:` policies say. Everything dropped is counted and recorded.",
    ),
]
Paranoid = Annotated[
    bool, typer.Option("--paranoid", metavar=FLAG, help="Catch operators that write into their inputs.")
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", metavar=FLAG, help="No progress display.")]


@dataclass(frozen=True, slots=True)
class _Outputs:
    """What a run leaves behind or shows, checked before anything starts."""

    record: Path | None
    view_file: Path | None
    live_view: str | None
    open_file: bool
    overwrite: bool


def run(
    graph: GraphFile,
    settings: Settings = None,
    path: ModuleFolders = None,
    rate: Rate = None,
    timeout: Timeout = 120.0,
    live: Live = False,
    paranoid: Paranoid = False,
    chaos: Annotated[
        Path | None,
        typer.Option("--chaos", metavar="PLAN.yaml", help="Let the faults of a plan happen; implies --live."),
    ] = None,
    chaos_seed: Annotated[
        int | None, typer.Option("--chaos-seed", metavar="N", help="Another seed than the plan's own.")
    ] = None,
    quiet: Quiet = False,
    one_process: OneProcess = False,
    process_each: ProcessEach = False,
    place: Place = None,
    record: Record = None,
    view: View = None,
    open_view: Open = False,
    overwrite: Replace = False,
    json: Json = False,
) -> None:
    """Run a graph.

    A table of its operators is shown while it runs, and a summary at the end. Ctrl-C ends it in order: sources stop,
    everything on its way is finished, files are closed; a second Ctrl-C ends it at once.

    Examples:

      dataflow run graphs/synthetic_rgbd.yaml
      dataflow run graphs/synthetic_rgbd.yaml --record run.mcap --view spawn
      dataflow run graphs/rgbd_perception.yaml --set data=FOLDER
      dataflow run graphs/synthetic_rgbd.yaml --view run.rrd --open
      dataflow run graphs/synthetic_rgbd.yaml --process-each --rate 1 --json
      dataflow run graphs/simulated_robot.yaml --live --record live.mcap
      dataflow run graphs/chaos/robot.yaml --chaos graphs/chaos/plan.yaml
    """
    began = time.monotonic()
    from dataflow.chaos.plan import load_plan
    from dataflow.graph import load_graph
    from dataflow.supervision.run import run as run_graph

    with friendly_errors():
        if chaos_seed is not None and chaos is None:
            raise fail("--chaos-seed varies a fault plan: name it with --chaos")
        find_modules_in(path)
        live = live or chaos is not None
        loaded = load_graph(existing(graph, "a graph file"), settings=settings or (), live=live)
        outputs = _outputs(record, view, open_view, overwrite)
        options = _options(loaded, outputs, one_process, process_each, place, rate, paranoid, timeout)
        options["live"] = live
        if chaos is not None:
            options["faults"] = load_plan(existing(chaos, "a fault plan"), loaded, seed=chaos_seed)
        _execute(
            lambda watch: run_graph(loaded, watch=watch, **options),
            loaded,
            outputs,
            None,
            began=began,
            json=json,
            quiet=quiet,
        )


def replay(
    recording: RecordingFile,
    graph: Annotated[
        Path | None,
        typer.Option("--graph", metavar="GRAPH", help="Another graph than the one that made the recording."),
    ] = None,
    settings: Settings = None,
    path: ModuleFolders = None,
    start: Start = None,
    end: End = None,
    rate: Rate = None,
    timeout: Timeout = 120.0,
    paranoid: Paranoid = False,
    network: Network = False,
    quiet: Quiet = False,
    one_process: OneProcess = False,
    process_each: ProcessEach = False,
    place: Place = None,
    record: Record = None,
    view: View = None,
    open_view: Open = False,
    complete: Annotated[
        Path | None,
        typer.Option(
            "--complete",
            metavar="FILE.mcap",
            rich_help_panel=_OUTPUT,
            help="Compute what a thin recording leaves out, by its firing records, and write the complete recording.",
        ),
    ] = None,
    overwrite: Replace = False,
    json: Json = False,
) -> None:
    """Replay a recording through the graph that made it, or another one.

    Recorded streams replace the sources; everything else runs again, with identical results. Compare two recordings of
    it with `dataflow diff`. With --start, operators begin in the state they had then, where the recording is of the
    same operators: their last recorded snapshot, and what they did since, repeated.

    With --complete, a thin recording (sensors and firing records) becomes the complete recording of the same run:
    nothing is decided anew, so drops and timeouts of a live run are repeated, and every message has the recorded
    digest. Where one comes out otherwise, nothing is written and the exit code is 1; also 1 where firings could not be
    repeated, and what they made is missing.

    Exit codes:

      0    it ran to its end
      1    an operator failed; with --complete: not as recorded, or in part
      2    could not run: a wrong option, a recording that lacks something
      130  interrupted with Ctrl-C

    Examples:

      dataflow replay run.mcap
      dataflow replay run.mcap --start 5 --end 10 --rate 1 --view spawn
      dataflow replay run.mcap --graph other.yaml --set cloud.stride=8
      dataflow replay run.mcap --record again.mcap --view again.rrd --open
      dataflow replay thin.mcap --complete full.mcap
    """
    began = time.monotonic()
    from dataflow.graph import load_graph
    from dataflow.recording import Recording
    from dataflow.reexecution.recorded_run import graph_as_recorded, isolated
    from dataflow.supervision.replay import plan_replay
    from dataflow.supervision.run import replay as replay_recording

    with friendly_errors():
        existing(recording, "a recording")
        if record is not None and record.exists() and record.samefile(recording):
            raise fail(f"--record {record} is the recording that is being replayed; name another file")
        if graph is None and settings:
            raise fail("--set changes a graph file: name it with --graph")
        find_modules_in(path)
        with Recording(recording) as opened:
            if graph is None:
                recorded = graph_as_recorded(opened)
                loaded = recorded if network else isolated(recorded)
                if loaded.network != recorded.network:
                    say_network_ignored(recording)
            else:
                loaded = load_graph(existing(graph, "a graph file"), settings=settings or ())
            if complete is not None:
                alone = (start, end, rate, record, view, place) == (None,) * 6
                if not alone or open_view or one_process or process_each or paranoid:
                    raise fail(
                        "--complete repeats a run as it was, in one process: of the other options only --graph, "
                        "--set, --overwrite, --quiet and --json go with it"
                    )
                _complete(recording, loaded, complete, overwrite=overwrite, json=json, quiet=quiet)
                return
            whole = span(opened, plan_replay(opened, loaded).streams)
            begin, finish = window(whole, start, end, recording)
            if opened.torn:
                name = escape(str(recording))
                say(f"[yellow]{name} has no proper end:[/] what its writer had not stored when it died is missing")
            if begin is not None:
                _say_what_begins_fresh(opened, loaded)
        outputs = _outputs(record, view, open_view, overwrite)
        options = _options(loaded, outputs, one_process, process_each, place, rate, paranoid, timeout)
        shown = None
        if whole is not None:
            shown = (begin or whole[0], whole[1] if finish is None else min(whole[1], finish))
        _execute(
            lambda watch: replay_recording(recording, graph=loaded, start=start, end=end, watch=watch, **options),
            loaded,
            outputs,
            shown,
            began=began,
            json=json,
            quiet=quiet,
        )


def say_network_ignored(recording: Path) -> None:
    """Reports that the graph inside a recording would have opened ports or connected somewhere, and did not."""
    say(
        f"[yellow]not obeyed:[/] the `network:` section of the graph inside {escape(str(recording))}; this run stays "
        "on this machine (--network obeys it)"
    )


def _say_what_begins_fresh(recording: Recording, graph: Graph) -> None:
    """With --start: which operators cannot have the state they had then."""
    from dataflow.reexecution.warm_start import fresh_because

    for node in graph.nodes.values():
        if not node.source and (reason := fresh_because(recording, graph, node)) is not None:
            say(f"[yellow]{escape(node.name)} begins with fresh state:[/] {escape(reason)}")


def _complete(recording: Path, graph: Graph, file: Path, *, overwrite: bool, json: bool, quiet: bool) -> None:
    from dataflow.cli.progress import RunDisplay, shown
    from dataflow.cli.verdicts import print_completion
    from dataflow.verification.complete import complete

    if file.exists() and file.samefile(recording):
        raise fail(f"--complete {file} is the recording that is to be completed; name another file")
    output_file(file, ".mcap", overwrite=overwrite, option="--complete")
    with shown(err, RunDisplay(err), quiet=quiet) as watch:
        made = complete(recording, file, graph=graph, overwrite=overwrite, watch=watch)
    if json:
        print_json(made.as_json())
    else:
        print_completion(out, made)
    if not made.whole:
        raise typer.Exit(DIFFERENT)


def _outputs(record: Path | None, view: str | None, open_view: bool, overwrite: bool) -> _Outputs:
    saves = view is not None and view.endswith(".rrd")
    if view is not None and view not in ("spawn", "serve") and not saves:
        raise fail(f"--view {view!r}: expected spawn, serve, or a file name that ends in .rrd")
    if open_view and not saves:
        raise fail("--open opens a saved file: it needs --view FILE.rrd")
    if view == "spawn":
        from dataflow.cli.viewing import require_display

        require_display()
    if record is not None:
        output_file(record, ".mcap", overwrite=overwrite, option="--record")
    view_file = Path(view) if view is not None and saves else None
    if view_file is not None:
        output_file(view_file, ".rrd", overwrite=overwrite, option="--view")
    return _Outputs(record, view_file, None if saves else view, open_view, overwrite)


def _options(
    graph: Graph,
    outputs: _Outputs,
    one_process: bool,
    process_each: bool,
    place: list[str] | None,
    rate: float | None,
    paranoid: bool,
    timeout: float,
) -> dict[str, Any]:
    return {
        "placement": _placement(graph, one_process, process_each, place),
        "record": outputs.record,
        "overwrite": outputs.overwrite,
        "view_file": outputs.view_file,
        "rate": rate,
        "paranoid": paranoid,
        "stall_timeout": timeout,
        "start_timeout": timeout,
    }


def _placement(graph: Graph, one_process: bool, process_each: bool, place: list[str] | None) -> Any:
    if one_process + process_each + bool(place) > 1:
        raise fail("--one-process, --process-each and --place exclude each other")
    if not place:
        return "one_process" if one_process else "process_each" if process_each else "graph"
    placement = {}
    for word in place:
        operator, separator, process = word.partition("=")
        if not separator or not process or operator not in graph.nodes:
            known = ", ".join(graph.nodes)
            raise fail(f"--place {word!r}: expected OPERATOR=PROCESS with an operator of the graph ({known})")
        placement[operator] = process
    return placement


def _execute(
    start: Callable[[Watch | None], RunReport],
    graph: Graph,
    outputs: _Outputs,
    shown_span: tuple[int, int] | None,
    *,
    began: float,
    json: bool,
    quiet: bool,
) -> None:
    from dataflow.cli.progress import RunDisplay, shown
    from dataflow.cli.report import print_report, report_json
    from dataflow.cli.viewing import attached_viewer, open_saved
    from dataflow.supervision.report import RunFailed

    before = {file: _written(file) for file in (outputs.record, outputs.view_file) if file is not None}
    display = RunDisplay(err, sources=[node.name for node in graph.sources()], span=shown_span)
    try:
        with attached_viewer(outputs.live_view), shown(err, display, quiet=quiet) as watch:
            report = start(watch)
    except RunFailed:
        _say_what_is_left(before)
        raise
    if json:
        print_json({**report_json(report), "total_s": time.monotonic() - began})
    else:
        print_report(out, report, total=time.monotonic() - began)
    if outputs.open_file and outputs.view_file is not None:
        open_saved(outputs.view_file)
    if report.interrupted:
        raise typer.Exit(INTERRUPTED)


def _written(file: Path) -> tuple[int, int] | None:
    """Tells one content of a file from another; None where there is no such file."""
    return (found.st_ino, found.st_mtime_ns) if file.exists() and (found := file.stat()) else None


def _say_what_is_left(before: dict[Path, tuple[int, int] | None]) -> None:
    """After a failure: which files hold what came before it, other than those that were there already."""
    for file, earlier in before.items():
        if file.exists() and _written(file) != earlier:
            say(f"[dim]{escape(str(file))} ({size(file.stat().st_size)}) holds what came before the failure[/]")
