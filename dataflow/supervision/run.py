"""Runs and replays graphs: what the command line, tests and other programs call."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

from dataflow.execution.feeds.playable import PlayableStreams
from dataflow.execution.generators import seeding
from dataflow.execution.threads import environment
from dataflow.graph.model import Graph
from dataflow.recording import Recording
from dataflow.recording.streams.facts import machine_facts
from dataflow.reexecution.recorded_run import graph_metadata, recorded_graph
from dataflow.supervision.core.report import RunFailed, RunReport, Watch
from dataflow.supervision.early_nursery import EarlyNursery
from dataflow.supervision.interrupts import interrupts
from dataflow.supervision.plan import RunPlan
from dataflow.supervision.replay import plan_replay
from dataflow.supervision.sim_to_real import warn_of_gap
from dataflow.supervision.supervisor import Supervisor

Controls = Callable[[Supervisor], AbstractContextManager[None]]
"""Steers a run while it lasts."""


def run(
    graph: Graph,
    *,
    watch: Watch | None = None,
    early: EarlyNursery | None = None,
    controls: Controls | None = None,
    **options: Any,
) -> RunReport:
    """Runs a graph's own sources. `controls` may pause and step them, unless the run is live. Further options are the
    fields of `RunPlan`. Raises `RunFailed`; so does a graph that names machines without `machines` (None: all of it
    runs here)."""
    named = sorted({node.machine for node in graph.nodes.values() if node.machine is not None})
    if named and "machines" not in options:
        raise RunFailed(
            f"operators are to run on machine {', '.join(named)}: say where machines join (--listen ENDPOINT --keys "
            "FOLDER), or run all of it here (--here)"
        )
    warn_of_gap(graph)
    return execute(RunPlan(graph, **options), mode="run", watch=watch, early=early, controls=controls)


def replay(
    played: Path | PlayableStreams,
    *,
    graph: Graph | None = None,
    start: float | None = None,
    end: float | None = None,
    watch: Watch | None = None,
    early: EarlyNursery | None = None,
    controls: Controls | None = None,
    **options: Any,
) -> RunReport:
    """Replays a recording through the graph that made it, or another one with the same sources.

    `played`: a recording by its path, or recorded streams that are open already, such as those of a bag; they stay so.
    `start` and `end` are seconds from the recording's first message. `controls` may pause and step it. Further options
    are the fields of `RunPlan`. Raises `ReplayError`, `RunFailed`.
    """
    with Recording(played) if isinstance(played, Path) else nullcontext(played) as recording:
        loaded = graph or recorded_graph(recording)
        log = plan_replay(recording, loaded, start=start, end=end)
        warn_of_gap(loaded, recording)
    return execute(RunPlan(loaded, log=log, **options), mode="replay", watch=watch, early=early, controls=controls)


def execute(
    plan: RunPlan,
    *,
    mode: str,
    watch: Watch | None = None,
    early: EarlyNursery | None = None,
    controls: Controls | None = None,
) -> RunReport:
    """Runs a plan under a supervisor; Ctrl-C asks it for an orderly end, a second one ends it at once.

    `early`: a nursery that was started already. `controls`: is entered with the supervisor while it runs.
    """
    for file in (plan.record, plan.view_file):
        if file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
    if plan.keeps_records:
        plan = replace(plan, metadata=_metadata(plan, mode))
    supervisor = Supervisor(plan, early=early)
    steered = nullcontext() if controls is None else controls(supervisor)
    with interrupts(supervisor.stop), _watching(supervisor, watch), steered:
        return supervisor.run()


def _metadata(plan: RunPlan, mode: str) -> Mapping[str, Mapping[str, str]]:
    placed = {node: label for label, nodes in plan.graph.processes(plan.placement).items() for node in nodes}
    run_facts = {
        "mode": mode,
        "started": str(time.time_ns()),
        "rate": "as fast as it goes" if plan.rate is None else str(plan.rate),
        "seed": str(plan.graph.seed),
        seeding.FACT: str(seeding.VERSION),
        "threads": str(plan.graph.threads),
        **{f"process of {node}": label for node, label in placed.items()},
        **{
            f"machine of {node.name}": node.machine
            for node in plan.graph.nodes.values()
            if plan.machines and node.machine
        },
    }
    facts = machine_facts(environment(plan.graph.threads))
    return {**plan.metadata, **graph_metadata(plan.graph), "dataflow:run": run_facts, **facts}


@contextmanager
def _watching(supervisor: Supervisor, watch: Watch | None, period: float = 0.2) -> Iterator[None]:
    """Calls `watch` with the status a few times a second, and once at the end."""
    if watch is None:
        yield
        return
    over = threading.Event()

    def loop() -> None:
        while not over.wait(period):
            watch(supervisor.status)

    thread = threading.Thread(target=loop, name="watch", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join(timeout=2.0)
        watch(supervisor.status)
