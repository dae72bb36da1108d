"""`dataflow run`."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from dataflow.cli.commands.playback import keys
from dataflow.cli.support.arguments import GraphFile, ModuleFolders, Settings, existing, find_modules_in, graph_file
from dataflow.cli.support.execution import Outputs, checked_outputs, execute, plan_options
from dataflow.cli.support.options import option
from dataflow.cli.support.output import fail
from dataflow.cli.support.run_options import (
    PLACEMENT,
    TIMEOUT,
    Keys,
    Listen,
    Paranoid,
    PlacementOptions,
    Rate,
    Replace,
    ReportOptions,
    Step,
    Timeout,
    ViewOptions,
    machines_of,
)
from dataflow.cli.support.storage import RecordOptions

if TYPE_CHECKING:
    from dataflow.graph import Graph

LOG_LEVELS = ("debug", "info", "warning", "error")


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOptions:
    """The options of `dataflow run`, in the order of its help."""

    settings: Settings = None
    path: ModuleFolders = None
    listen: Listen = None
    keys: Keys = None
    here: Annotated[bool, option("--here", "Run everything here, without regard to `machine:`.", PLACEMENT)] = False
    rate: Rate = None
    step: Step = False
    timeout: Timeout = TIMEOUT
    live: Annotated[
        bool,
        option(
            "--live",
            "Time does not wait: sources run by the clock, and operators that are too slow drop messages as their "
            "`live:` policies say. Everything dropped is counted and recorded.",
        ),
    ] = False
    paranoid: Paranoid = False
    chaos: Annotated[Path | None, option("--chaos PLAN.yaml", "Let the faults of a plan happen; implies --live.")] = (
        None
    )
    chaos_seed: Annotated[int | None, option("--chaos-seed N", "Another seed than the plan's own.")] = None
    log_level: Annotated[
        str | None,
        option(
            "--log-level LEVEL",
            "The least level that operators' loggers hand on: debug, info, warning, error. Default: info. "
            "Environment: DATAFLOW_LOG_LEVEL.",
        ),
    ] = None
    placed: PlacementOptions
    recorded: RecordOptions
    viewed: ViewOptions
    overwrite: Replace = False
    told: ReportOptions


def run(graph: GraphFile, options: RunOptions) -> None:
    """Run a graph.

    A table of its operators is shown while it runs, and a summary at the end. Ctrl-C ends it in order: sources stop,
    everything on its way is finished, files are closed; a second Ctrl-C ends it at once.

    In a terminal, space pauses a run that is not live and lets it go on, the right arrow or n makes one step, + and -
    double and halve its speed, q ends it; `dataflow playback` does the same from elsewhere, with the same results.

    A graph with `record: {keep: 60s}` has a flight recorder, unless --record keeps everything: its history is
    saved on a trigger, with `dataflow trigger`, or by the key k.

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

    if options.chaos_seed is not None and options.chaos is None:
        raise fail("--chaos-seed varies a fault plan: name it with --chaos")
    if options.log_level not in (None, *LOG_LEVELS):
        raise fail(f"--log-level {options.log_level}: expected one of {', '.join(LOG_LEVELS)}")
    file = graph_file(graph)
    find_modules_in(options.path)
    with early_nursery() as early:
        from dataflow.graph import load_graph
        from dataflow.process.log_pipe import LEVEL_VARIABLE
        from dataflow.supervision.run import run as run_graph

        if options.log_level is not None:
            os.environ[LEVEL_VARIABLE] = options.log_level
        live = options.live or options.chaos is not None
        if live and options.step:
            raise fail("--step pauses what reads its sources; a live run cannot wait: devices go on by the clock")
        loaded = load_graph(file, settings=options.settings or (), live=live)
        outputs, plan = _planned(loaded, options, live=live)
        execute(
            lambda watch: run_graph(loaded, watch=watch, early=early, **plan),
            loaded,
            outputs,
            None,
            options.told,
            began=began,
        )


def _planned(graph: Graph, options: RunOptions, *, live: bool) -> tuple[Outputs, dict[str, Any]]:
    """The checked outputs and the fields of the `RunPlan`."""
    recorder = graph.record.flight if options.recorded.record is None else None
    flight, hidden = recorder is not None, options.told.quiet or options.told.json
    outputs = checked_outputs(options.recorded, options.viewed, overwrite=options.overwrite, flight=flight)
    plan = plan_options(
        graph, outputs, options.placed, rate=options.rate, paranoid=options.paranoid, timeout=options.timeout
    )
    plan |= {"live": live, "paused": options.step, "controls": keys(hidden, live=live, flight=flight)}
    plan |= machines_of(graph, options.listen, options.keys, here=options.here)
    if recorder is not None:
        plan["flight"] = Path(recorder.folder)
        plan["flight"].mkdir(parents=True, exist_ok=True)
    if options.chaos is not None:
        from dataflow.chaos.plan import load_plan

        plan["faults"] = load_plan(existing(options.chaos, "a fault plan"), graph, seed=options.chaos_seed)
    return outputs, plan
