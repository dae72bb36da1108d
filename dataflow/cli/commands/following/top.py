"""`dataflow top`: the status of every operator of a running graph."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.text import Text

from dataflow.cli.commands.following.live import THE_ONLY, Running
from dataflow.cli.support.options import option
from dataflow.cli.support.output import INTERRUPTED, err, fail, out, print_json

if TYPE_CHECKING:
    from dataflow.cli.support.status_table import Sample
    from dataflow.client.processes import Processes
    from dataflow.transport.registry import RunningGraph

ANSWER_WITHIN = 1.0
"""Seconds after which a process counts as silent."""
CONNECT_WITHIN = 3.0
FIRST_AFTER = 0.1
"""Seconds over which the first table's rates are taken."""


def top(
    once: Annotated[bool, option("--once", "Print one table and end.")] = False,
    every: Annotated[float, option("--every SECONDS", "Time between two updates.")] = 1.0,
    which: Running = THE_ONLY,
    json: Annotated[bool, option("--json", "Print one sample as JSON and end.")] = False,
) -> None:
    """Show the status of every operator of a running graph, and the latency of every path through it.

    States: running; dropping (messages reached no firing); timeout (it fired without an input that it had waited
    for, which drops nothing); late (messages came after the firing that they were for); silent (nothing for a
    while); starting; ended; no answer (its process is being restarted, or hangs).

    Hz, CPU and wall are since the last update: CPU is the CPU time of an operator's calls, wall their wall time, with
    what they wait for. dropped, timeouts and late count since the process began. lag is, of a source, how far it is
    behind the clock; of any other operator, how far its event time is behind the foremost one's.

    Latency is over the last 10 seconds, from a source's message to the end of the sink's firing that it causes, with
    the operator that costs most. Where the output is no terminal, every update is a line for each operator. Ends with
    the graph, or at Ctrl-C.

    Examples:

      dataflow top
      dataflow top --once
      dataflow top --every 0.5 --graph robot
      dataflow top | grep detector
      dataflow top --json
    """
    from dataflow.client.processes import processes_of

    if not 0.05 <= every < 1e6:
        raise fail(f"--every {every:g}: expected seconds, 0.05 or more")
    found = which.followed()
    with processes_of(found) as processes:
        processes.connected(len(found.endpoints), CONNECT_WITHIN)
        try:
            if once or json:
                _print_one(found, processes, every, json=json)
            elif out.is_terminal:
                _follow(found, processes, every)
            else:
                _print_lines(found, processes, every)
        except KeyboardInterrupt:
            raise typer.Exit(INTERRUPTED) from None
    if not (once or json):
        err.print(Text(f"{found.name} has ended"))


def _samples(
    found: RunningGraph, processes: Processes, first: float, every: float, *, latencies: bool = True
) -> Iterator[Sample]:
    """Samples of a running graph, after `first` seconds, then every so many, until it ends; one at least."""
    from dataflow.cli.support.status_table import StatusTable
    from dataflow.client.attach import graph_of, still_runs

    table = StatusTable(graph_of(found))
    several = any(node.machine is not None for node in table.graph.nodes.values())
    table.update(processes.statuses(ANSWER_WITHIN), time.monotonic())
    time.sleep(first)
    while True:
        sample = table.update(processes.statuses(ANSWER_WITHIN, firings=latencies), time.monotonic())
        yield replace(sample, machines=processes.machines(ANSWER_WITHIN)) if several else sample
        if not still_runs(found):
            return
        time.sleep(every)


def _print_one(found: RunningGraph, processes: Processes, every: float, *, json: bool) -> None:
    from dataflow.cli.support.status_table import as_json, shown

    sample = next(_samples(found, processes, every, every))
    if json:
        print_json({"graph": found.name, **as_json(sample)})
    else:
        out.print(shown(sample, found))


def _follow(found: RunningGraph, processes: Processes, every: float) -> None:
    """Shows one table, which changes; the last one stays."""
    from rich.live import Live

    from dataflow.cli.support.status_table import shown

    last: Any = None
    with Live(console=out, auto_refresh=False, transient=True) as live:
        for sample in _samples(found, processes, min(FIRST_AFTER, every), every):
            last = shown(sample, found)
            live.update(last, refresh=True)
    if last is not None:
        out.print(last)


def _print_lines(found: RunningGraph, processes: Processes, every: float) -> None:
    """Prints a heading once, then a line for each operator at every update; a note when a source falls behind."""
    from dataflow.cli.support.status_table import heading, line

    printed: Sequence[str] = ()
    behind: Mapping[str, str] = {}
    for sample in _samples(found, processes, every, every, latencies=False):
        if not printed:
            out.print(Text(heading(sample)), soft_wrap=True)
        printed = [line(row, sample, time.time() - found.started) for row in sample.rows]
        out.print(Text("\n".join(printed)), soft_wrap=True)
        for note in (note for source, note in sample.behind.items() if source not in behind):
            err.print(Text(f"note: {note}", style="yellow"), soft_wrap=True)
        behind = sample.behind
