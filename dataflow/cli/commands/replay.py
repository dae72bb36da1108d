"""`dataflow replay`, which also completes thin recordings."""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from dataflow.cli.commands.playback import keys, looped
from dataflow.cli.support.arguments import (
    AnyRecording,
    BagOptions,
    End,
    ModuleFolders,
    Network,
    OtherGraph,
    OtherSettings,
    Start,
    existing_recording,
    find_modules_in,
    graph_file,
    output_file,
    refuse_of_recording,
    span,
    window,
)
from dataflow.cli.support.execution import Outputs, checked_outputs, execute, plan_options
from dataflow.cli.support.options import option
from dataflow.cli.support.output import DIFFERENT, err, fail, out, print_json, say
from dataflow.cli.support.run_options import (
    TIMEOUT,
    Paranoid,
    PlacementOptions,
    Rate,
    Replace,
    ReportOptions,
    Step,
    Timeout,
    ViewOptions,
)
from dataflow.cli.support.storage import OUTPUT, RecordOptions

if TYPE_CHECKING:
    from dataflow.graph import Graph
    from dataflow.recording import Recording
    from dataflow.supervision.core.report import RunReport, Watch


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayOptions:
    """The options of `dataflow replay`, in the order of its help."""

    graph: OtherGraph = None
    bag: BagOptions
    settings: OtherSettings = None
    path: ModuleFolders = None
    start: Start = None
    end: End = None
    rate: Rate = None
    step: Step = False
    loop: Annotated[int, option("--loop N", "Replay N times, and compare the passes; 0: until Ctrl-C.")] = 1
    timeout: Timeout = TIMEOUT
    paranoid: Paranoid = False
    network: Network = False
    placed: PlacementOptions
    recorded: RecordOptions
    viewed: ViewOptions
    complete: Annotated[
        Path | None,
        option(
            "--complete FILE.mcap",
            "Compute what a thin recording leaves out, by its firing records, and write the complete recording.",
            OUTPUT,
        ),
    ] = None
    overwrite: Replace = False
    told: ReportOptions


def replay(recording: AnyRecording, options: ReplayOptions) -> None:
    """Replay a recording through the graph that made it, or another one.

    Recorded streams replace the sources; everything else runs again, with identical results. Compare two recordings of
    it with `dataflow diff`. With --start, operators begin in the state they had then, where the recording is of the
    same operators: their last recorded snapshot, and what they did since, repeated.

    A ROS 1 or ROS 2 bag (file or folder) or any MCAP stands in for the sources of a graph, which --graph names: --map
    assigns topics to streams. Without it, topics are matched by message type, and where that leaves a choice,
    the error proposes a mapping. Messages are stamped with the time in their headers, or where that cannot be trusted
    with the time of their recording; which, and why, is printed.

    In a terminal, space pauses it and lets it go on, the right arrow or n makes one step (all messages of one
    timestamp), + and - double and halve its speed, q ends it; `dataflow playback` does the same from elsewhere. Results
    do not depend on that.

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
      dataflow replay run.mcap --step --view spawn
      dataflow replay run.mcap --rate 1 --loop 3
      dataflow replay thin.mcap --complete full.mcap
      dataflow replay drive.bag --graph g.yaml --map /rgb=camera/image
    """
    began = time.monotonic()
    from dataflow.supervision.early_nursery import early_nursery

    with ExitStack() as stack:
        _check(existing_recording(recording), options)
        find_modules_in(options.path)
        early = None if options.complete is not None else stack.enter_context(early_nursery())
        from dataflow.graph import load_graph
        from dataflow.interop.opening import is_foreign

        file, settings = options.graph, options.settings or ()
        given = None if file is None else load_graph(graph_file(file), settings=settings)
        if options.bag.maps or is_foreign(recording):
            _replay_bag(recording, given, options, early, began)
        else:
            _replay_recording(recording, given, options, early, began)


def _check(recording: Path, options: ReplayOptions) -> None:
    record, loop = options.recorded.record, options.loop
    if record is not None and record.exists() and record.samefile(recording):
        raise fail(f"--record {record} is the recording that is being replayed; name another file")
    if loop < 0:
        raise fail(f"--loop {loop}: expected 1 or more, or 0 for no end")
    if loop != 1 and (record, options.viewed.view, options.complete) != (None,) * 3:
        raise fail("--loop makes the same in each pass: it does not go with --record, --view or --complete")
    if options.graph is None and options.settings:
        raise fail("--set changes a graph file: name it with --graph")
    options.recorded.storage()


def _planned(graph: Graph, options: ReplayOptions, early: Any) -> tuple[Outputs, dict[str, Any]]:
    """The checked outputs and the fields of the `RunPlan`."""
    outputs = checked_outputs(options.recorded, options.viewed, overwrite=options.overwrite)
    plan = plan_options(
        graph, outputs, options.placed, rate=options.rate, paranoid=options.paranoid, timeout=options.timeout
    )
    controls = keys(options.told.quiet or options.told.json)
    return outputs, plan | {"early": early, "paused": options.step, "controls": controls}


def _replay_bag(bag: Path, graph: Graph | None, options: ReplayOptions, early: Any, began: float) -> None:
    from dataflow.cli.support.bags import replay_bag
    from dataflow.interop.opening import open_bag

    if graph is None:
        open_bag(bag).close()
        raise fail(f"{bag} does not hold the graph that made it: name one with --graph")
    if options.complete is not None:
        raise fail("--complete needs the firing records of a run, which bags do not hold")
    outputs, plan = _planned(graph, options, early)
    if outputs.storage is not None and outputs.storage.splitting.splits:
        raise fail("of a bag no split recording is made; split it afterwards: dataflow split FILE.mcap")
    if options.loop != 1:
        raise fail("--loop needs a recording; make one of the bag: dataflow convert BAG OUT.mcap --to mcap")
    replay_bag(bag, graph, options.bag, options.start, options.end, outputs, plan, options.told, began=began)


def _replay_recording(recording: Path, given: Graph | None, options: ReplayOptions, early: Any, began: float) -> None:
    from dataflow.recording import Recording
    from dataflow.supervision.run import replay as replay_recording

    with Recording(refuse_of_recording(recording, options.bag.clock, strict=options.bag.strict)) as opened:
        graph = _recorded_graph(opened, network=options.network) if given is None else given
        if options.complete is not None:
            _complete(recording, graph, options.complete, options)
            return
        shown = _shown(opened, graph, options.start, options.end)
    outputs, plan = _planned(graph, options, early)
    plan |= {"graph": graph, "start": options.start, "end": options.end}

    def playing(watch: Watch | None) -> RunReport:
        return replay_recording(recording, watch=watch, **plan)

    looped(options.loop, lambda: dict(execute(playing, graph, outputs, shown, options.told, began=began).streams))


def _recorded_graph(recording: Recording, *, network: bool) -> Graph:
    from dataflow.reexecution.recorded_run import graph_as_recorded, isolated

    recorded = graph_as_recorded(recording)
    graph = recorded if network else isolated(recorded)
    if graph.network != recorded.network:
        say_network_ignored(recording.path)
    return graph


def _shown(recording: Recording, graph: Graph, start: float | None, end: float | None) -> tuple[int, int] | None:
    """Returns the stamps between which is replayed, ns; prints what such a part cannot have as it was."""
    from dataflow.recording.mcap.index import NO_END
    from dataflow.recording.streams.cutting import cut_of
    from dataflow.supervision.replay import plan_replay

    whole = span(recording, plan_replay(recording, graph).streams)
    begin, finish = window(whole, start, end, recording.path)
    if recording.torn:
        say(f"[yellow]{escape(str(recording.path))} {escape(NO_END)}[/]")
    part = cut_of(recording.metadata)
    begin = part.start if begin is None and part is not None else begin
    if begin is not None:
        _say_what_begins_fresh(recording, graph, begin)
    return None if whole is None else (begin or whole[0], whole[1] if finish is None else min(whole[1], finish))


def say_network_ignored(recording: Path) -> None:
    """Reports that the graph inside a recording would have opened ports or connected somewhere, and did not."""
    say(
        f"[yellow]not obeyed:[/] the `network:` section of the graph inside {escape(str(recording))}; this run stays "
        "on this machine (--network obeys it)"
    )


def _say_what_begins_fresh(recording: Recording, graph: Graph, stamp: int) -> None:
    """With --start, and of a part: which operators cannot have the state they had then."""
    from dataflow.reexecution.warm_start import fresh_because

    for node in graph.nodes.values():
        if not node.source and (reason := fresh_because(recording, graph, node, stamp)) is not None:
            say(f"[yellow]{escape(node.name)} begins with fresh state:[/] {escape(reason)}")


def _complete(recording: Path, graph: Graph, file: Path, options: ReplayOptions) -> None:
    from dataflow.cli.support.progress import RunDisplay, shown
    from dataflow.cli.support.verdicts import print_completion
    from dataflow.verification.complete import complete

    others = (options.start, options.end, options.rate, options.recorded.record, options.viewed, options.placed)
    if others != (*(None,) * 4, ViewOptions(), PlacementOptions()) or options.paranoid:
        raise fail(
            "--complete repeats a run as it was, in one process: of the other options only --graph, "
            "--set, --overwrite, --quiet and --json go with it"
        )
    if file.exists() and file.samefile(recording):
        raise fail(f"--complete {file} is the recording that is to be completed; name another file")
    output_file(file, ".mcap", overwrite=options.overwrite, option="--complete")
    with shown(err, RunDisplay(err), quiet=options.told.quiet) as watch:
        made = complete(recording, file, graph=graph, overwrite=options.overwrite, watch=watch)
    if options.told.json:
        print_json(made.as_json())
    else:
        print_completion(out, made)
    if not made.whole:
        raise typer.Exit(DIFFERENT)
