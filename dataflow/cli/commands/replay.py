"""`dataflow replay`, which also completes thin recordings."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from dataflow.cli.commands.playback import keys, looped
from dataflow.cli.support.arguments import (
    AnyRecording,
    Clock,
    End,
    Map,
    ModuleFolders,
    Network,
    OtherGraph,
    OtherSettings,
    Start,
    Strict,
    existing_recording,
    find_modules_in,
    graph_file,
    output_file,
    refuse_of_recording,
    span,
    window,
)
from dataflow.cli.support.execution import Outputs, checked_outputs, execute, plan_options
from dataflow.cli.support.output import DIFFERENT, err, fail, friendly_errors, out, print_json, say
from dataflow.cli.support.run_options import (
    OUTPUT,
    Compression,
    Json,
    OneProcess,
    Open,
    Paranoid,
    Place,
    ProcessEach,
    Quiet,
    Rate,
    Record,
    Replace,
    Step,
    Timeout,
    Verbose,
    View,
)
from dataflow.cli.support.storage import KeepDisk, OnFailure, Readable, SplitEvery, SplitSize, storage_of

if TYPE_CHECKING:
    from dataflow.graph import Graph
    from dataflow.recording import Recording
    from dataflow.supervision.core.report import RunReport, Watch


def replay(
    recording: AnyRecording,
    graph: OtherGraph = None,
    maps: Map = None,
    clock: Clock = "auto",
    strict: Strict = False,
    settings: OtherSettings = None,
    path: ModuleFolders = None,
    start: Start = None,
    end: End = None,
    rate: Rate = None,
    step: Step = False,
    loop: Annotated[
        int, typer.Option("--loop", metavar="N", help="Replay N times, and compare the passes; 0: until Ctrl-C.")
    ] = 1,
    timeout: Timeout = 120.0,
    paranoid: Paranoid = False,
    network: Network = False,
    quiet: Quiet = False,
    one_process: OneProcess = False,
    process_each: ProcessEach = False,
    place: Place = None,
    record: Record = None,
    compression: Compression = None,
    split_every: SplitEvery = None,
    split_size: SplitSize = None,
    keep_disk: KeepDisk = None,
    record_failure: OnFailure = None,
    readable: Readable = "owner",
    view: View = None,
    open_view: Open = False,
    complete: Annotated[
        Path | None,
        typer.Option(
            "--complete",
            metavar="FILE.mcap",
            rich_help_panel=OUTPUT,
            help="Compute what a thin recording leaves out, by its firing records, and write the complete recording.",
        ),
    ] = None,
    overwrite: Replace = False,
    verbose: Verbose = False,
    json: Json = False,
) -> None:
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

    with friendly_errors(), ExitStack() as stack:
        existing_recording(recording)
        if record is not None and record.exists() and record.samefile(recording):
            raise fail(f"--record {record} is the recording that is being replayed; name another file")
        _check_loop(loop, written=(record, view, complete) != (None,) * 3)
        if graph is None and settings:
            raise fail("--set changes a graph file: name it with --graph")
        if compression is not None and record is None:
            raise fail("--compression is of a recording: name one with --record")
        storage = storage_of(record, split_every, split_size, keep_disk, record_failure, readable)
        packing = {} if compression is None else {"compression": compression}
        find_modules_in(path)
        early = None if complete is not None else stack.enter_context(early_nursery())
        from dataflow.graph import load_graph
        from dataflow.interop.opening import is_foreign
        from dataflow.recording import Recording
        from dataflow.supervision.run import replay as replay_recording

        def planned(loaded: Graph) -> tuple[Outputs, dict[str, Any]]:
            outputs = checked_outputs(record, view, open_view, overwrite, storage)
            options = plan_options(loaded, outputs, one_process, process_each, place, rate, paranoid, timeout)
            return outputs, options | {"early": early, "paused": step, "controls": keys(quiet or json), **packing}

        given = None if graph is None else load_graph(graph_file(graph), settings=settings or ())
        if maps or is_foreign(recording):
            from dataflow.cli.support.bags import replay_bag

            given = _graph_of_bag(recording, given, completed=complete is not None)
            outputs, options = planned(given)
            _check_bag(loop, splits=storage.splitting.splits)
            words = (recording, given, maps or (), clock, start, end, outputs, options)
            replay_bag(*words, strict=strict, began=began, json=json, quiet=quiet, verbose=verbose)
            return
        with Recording(refuse_of_recording(recording, clock, strict=strict)) as opened:
            loaded = _recorded_graph(opened, network=network) if given is None else given
            if complete is not None:
                others = (start, end, rate, record, view, place)
                _check_complete(others != (None,) * 6 or any((open_view, one_process, process_each, paranoid)))
                _complete(recording, loaded, complete, overwrite=overwrite, json=json, quiet=quiet)
                return
            shown = _shown(opened, loaded, start, end)
        outputs, options = planned(loaded)

        options |= {"graph": loaded, "start": start, "end": end}
        told: dict[str, Any] = {"began": began, "json": json, "quiet": quiet, "verbose": verbose}

        def playing(watch: Watch | None) -> RunReport:
            return replay_recording(recording, watch=watch, **options)

        looped(loop, lambda: dict(execute(playing, loaded, outputs, shown, **told).streams))


def _check_loop(loop: int, *, written: bool) -> None:
    if loop < 0:
        raise fail(f"--loop {loop}: expected 1 or more, or 0 for no end")
    if loop != 1 and written:
        raise fail("--loop makes the same in each pass: it does not go with --record, --view or --complete")


def _check_bag(loop: int, *, splits: bool) -> None:
    if splits:
        raise fail("of a bag no split recording is made; split it afterwards: dataflow split FILE.mcap")
    if loop != 1:
        raise fail("--loop needs a recording; make one of the bag: dataflow convert BAG OUT.mcap --to mcap")


def _check_complete(others: bool) -> None:
    if others:
        raise fail(
            "--complete repeats a run as it was, in one process: of the other options only --graph, "
            "--set, --overwrite, --quiet and --json go with it"
        )


def _graph_of_bag(bag: Path, graph: Graph | None, *, completed: bool) -> Graph:
    from dataflow.interop.opening import open_bag

    if graph is None:
        open_bag(bag).close()
        raise fail(f"{bag} does not hold the graph that made it: name one with --graph")
    if completed:
        raise fail("--complete needs the firing records of a run, which bags do not hold")
    return graph


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


def _complete(recording: Path, graph: Graph, file: Path, *, overwrite: bool, json: bool, quiet: bool) -> None:
    from dataflow.cli.support.progress import RunDisplay, shown
    from dataflow.cli.support.verdicts import print_completion
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
