"""`dataflow run`."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dataflow.cli.commands.playback import keys
from dataflow.cli.support.arguments import (
    GraphFile,
    ModuleFolders,
    Settings,
    existing,
    find_modules_in,
    graph_file,
)
from dataflow.cli.support.execution import checked_outputs, execute, plan_options
from dataflow.cli.support.output import fail, friendly_errors
from dataflow.cli.support.run_options import (
    Compression,
    Here,
    Json,
    Keys,
    Listen,
    Live,
    LogLevel,
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
    machines_of,
)
from dataflow.cli.support.storage import KeepDisk, OnFailure, Readable, SplitEvery, SplitSize, storage_of

if TYPE_CHECKING:
    from dataflow.graph import Graph

LOG_LEVELS = ("debug", "info", "warning", "error")


def run(
    graph: GraphFile,
    settings: Settings = None,
    path: ModuleFolders = None,
    listen: Listen = None,
    keys_folder: Keys = None,
    here: Here = False,
    rate: Rate = None,
    step: Step = False,
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
    log_level: LogLevel = None,
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
    overwrite: Replace = False,
    verbose: Verbose = False,
    json: Json = False,
) -> None:
    """Run a graph.

    A table of its operators is shown while it runs, and a summary at the end. Ctrl-C ends it in order: sources stop,
    everything on its way is finished, files are closed; a second Ctrl-C ends it at once.

    In a terminal, space pauses a run that is not live and lets it go on, the right arrow or n makes one step, + and -
    double and halve its speed, q ends it; `dataflow playback` does the same from elsewhere, with the same results.

    A graph with `record: {keep: 60s}` has a flight recorder, unless --record keeps everything: what was is kept on a
    trigger, with `dataflow trigger`, or by the key k.

    Examples:

      dataflow run graphs/synthetic_rgbd.yaml
      dataflow run graphs/synthetic_rgbd.yaml --record run.mcap --view spawn
      dataflow run graphs/rgbd_perception.yaml --set data=FOLDER
      dataflow run graphs/synthetic_rgbd.yaml --process-each --rate 1 --json
      dataflow run graphs/simulated_robot.yaml --rate 1 --step --view spawn
      dataflow run robot.yaml --live --listen tls/192.168.1.2:7447 --keys laptop
      dataflow run robot.yaml --live --record "out/{time}.mcap" --keep-disk 20GB
      dataflow run graphs/chaos/robot.yaml --chaos graphs/chaos/plan.yaml
    """
    began = time.monotonic()
    from dataflow.supervision.early_nursery import early_nursery

    if chaos_seed is not None and chaos is None:
        raise fail("--chaos-seed varies a fault plan: name it with --chaos")
    if log_level not in (None, *LOG_LEVELS):
        raise fail(f"--log-level {log_level}: expected one of {', '.join(LOG_LEVELS)}")
    file = graph_file(graph)
    find_modules_in(path)
    with early_nursery() as early, friendly_errors():
        from dataflow.graph import load_graph
        from dataflow.process.log_pipe import LEVEL_VARIABLE
        from dataflow.supervision.run import run as run_graph

        if log_level is not None:
            os.environ[LEVEL_VARIABLE] = log_level
        live = live or chaos is not None
        if live and step:
            raise fail("--step pauses what reads its sources; a live run cannot wait: devices go on by the clock")
        loaded = load_graph(file, settings=settings or (), live=live)
        flight = loaded.record.flight is not None and record is None
        storage = storage_of(record, split_every, split_size, keep_disk, record_failure, readable, flight=flight)
        outputs = checked_outputs(record, view, open_view, overwrite, storage)
        options = plan_options(loaded, outputs, one_process, process_each, place, rate, paranoid, timeout)
        options |= {"live": live, "paused": step, "controls": keys(quiet or json, live=live, flight=flight)}
        options |= machines_of(loaded, listen, keys_folder, here=here)
        if compression is not None and record is None and not flight:
            raise fail("--compression is of a recording: name one with --record")
        options |= {} if compression is None else {"compression": compression}
        options |= _flight_folder(loaded) if flight else {}
        if chaos is not None:
            from dataflow.chaos.plan import load_plan

            options["faults"] = load_plan(existing(chaos, "a fault plan"), loaded, seed=chaos_seed)
        execute(
            lambda watch: run_graph(loaded, watch=watch, early=early, **options),
            loaded,
            outputs,
            None,
            began=began,
            json=json,
            quiet=quiet,
            verbose=verbose,
        )


def _flight_folder(graph: Graph) -> dict[str, Path]:
    assert graph.record.flight is not None
    folder = Path(graph.record.flight.folder)
    folder.mkdir(parents=True, exist_ok=True)
    return {"flight": folder}
