"""`dataflow health` and `dataflow metrics`: whether a running graph does its work, for programs that watch over it."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.text import Text

from dataflow.cli.commands.following.live import THE_ONLY, Running
from dataflow.cli.support.arguments import Json
from dataflow.cli.support.options import option
from dataflow.cli.support.output import DIFFERENT, INTERRUPTED, fail, out, print_json, say, seconds, size

if TYPE_CHECKING:
    from dataflow.cli.support.status_table import Row
    from dataflow.client.processes import ProcessStatus
    from dataflow.graph.model import Graph

ANSWER_WITHIN = 1.0
CONNECT_WITHIN = 3.0
PERIODS = 5
"""Usual periods of an operator after which it counts as silent."""
FIRST_CALL = 10.0
"""Seconds of an operator's first call, which may load a network, after which it counts as silent."""
PORT = 9464
HERE = Path()

Folder = Annotated[Path, option("--folder DIR", "Where recordings are written: its disk, here, is looked at.")]


def health(
    rate: Annotated[
        list[str] | None, option("--rate OPERATOR=HZ", "The least rate of an operator; may be repeated.")
    ] = None,
    losses: Annotated[float, option("--losses SHARE", "Share of messages that an operator may drop.", min=0.0)] = 0.1,
    free: Annotated[float, option("--free GB", "Free space on the disk.", min=0.0)] = 1.0,
    folder: Folder = HERE,
    over: Annotated[float, option("--over SECONDS", "Time over which rates are taken.", min=0.1, max=600)] = 2.0,
    which: Running = THE_ONLY,
    json: Json = False,
) -> None:
    """Check whether a running graph does its work: for a watchdog, a container's health check, a cron job.

    It does not where the process of an operator gives no answer, an operator was restarted meanwhile, no operator
    fires, one has not fired for five of its usual periods (and `--over`), is at its first call for 10 s, drops more
    than `--losses` of its messages or is slower than its `--rate`, or the disk has less than `--free` left. Each reason
    is a line.

    Exit codes: 0 healthy; 1 not; 2 no such graph runs.

    Examples:

      dataflow health
      dataflow health --rate camera=25 --rate detector=8 --folder out --free 5
    """
    from dataflow.cli.support.status_table import StatusTable
    from dataflow.client.attach import graph_of
    from dataflow.client.processes import processes_of

    found = which.found()
    resolved = graph_of(found)
    least = _rates(rate or (), resolved.nodes)
    table = StatusTable(resolved)
    with processes_of(found) as processes:
        processes.connected(len(found.endpoints), CONNECT_WITHIN)
        before = table.update(processes.statuses(ANSWER_WITHIN), time.monotonic())
        time.sleep(over)
        statuses = processes.statuses(ANSWER_WITHIN)
        sample = table.update(statuses, time.monotonic())
    reasons = [
        *faults(before.rows, sample.rows, least=least, losses=losses),
        *silent(resolved, statuses, time.time() - found.started, over),
        *_disk(folder, free),
    ]
    if json:
        print_json({"graph": found.name, "healthy": not reasons, "reasons": reasons})
    else:
        for reason in reasons:
            out.print(Text(reason), soft_wrap=True)
        if not reasons:
            out.print(Text(f"{found.name} is healthy: {len(sample.rows)} operators"), soft_wrap=True)
    if reasons:
        raise typer.Exit(DIFFERENT)


def faults(before: Sequence[Row], now: Sequence[Row], *, least: Mapping[str, float], losses: float) -> Iterator[str]:
    """Yields what is wrong with the operators of a graph, by two looks at them."""
    restarts = {row.operator: row.restarts for row in before}
    for row in now:
        handled = row.rate + row.drop_rate
        if row.state == "no answer":
            yield f"{row.operator}: its process does not answer"
        elif row.restarts > restarts[row.operator]:
            yield f"{row.operator}: was restarted ({row.restarts} times so far)"
        elif row.rate < least.get(row.operator, 0.0):
            yield f"{row.operator}: fires at {row.rate:.1f} Hz, less than {least[row.operator]:g}"
        elif handled and row.drop_rate / handled > losses:
            yield f"{row.operator}: drops {row.drop_rate / handled:.0%} of its messages"
    working = [row for row in now if row.state not in ("ended", "no answer")]
    if working and not any(row.rate for row in working):
        yield "no operator fires"


def silent(graph: Graph, statuses: Sequence[ProcessStatus], running: float, over: float) -> Iterator[str]:
    """Yields the operators that have not fired for `over` seconds and five of their usual periods, or are at their
    first call for `FIRST_CALL`, but those of which an operator in front is silent, too.

    `running`: seconds since the run began.
    """
    from dataflow.graph.reach import upstream

    quiet: dict[str, tuple[float, float]] = {}
    for status in statuses:
        for name, silence in status.silences.items():
            firings = status.counts[name][0] if name in status.counts else 0
            period = running / firings if firings else 0.0
            limit = max(over, PERIODS * period if firings else FIRST_CALL)
            if name in graph.nodes and name not in status.ended and silence > limit:
                quiet[name] = silence, period
    for name, (silence, period) in quiet.items():
        if upstream(graph, [name]).isdisjoint(quiet):
            since = f"has not fired for {seconds(silence)}; before, every {seconds(period)}"
            yield f"{name}: {since if period else f'has been at its first call for {seconds(silence)}'}"


def metrics(
    port: Annotated[int, option("--port PORT", "Of loopback; 0: a free one.")] = PORT, folder: Folder = HERE
) -> None:
    """Serve figures of all graphs that run here to Prometheus, at http://127.0.0.1:PORT/metrics, until Ctrl-C.

    Firings, messages, losses, waits, CPU and wall time, restarts and lag of every operator, and the free space of a
    disk, as they are when they are asked for. Graphs may come and go. Nothing listens beyond loopback. With --connect
    they are those of the graph of another machine.

    Examples:

      dataflow metrics
      dataflow metrics --port 9500 --folder out
    """
    from dataflow.client.attach import listing
    from dataflow.client.metrics import MetricsServer, collect

    graphs = listing()
    graphs()  # keys that are wrong are known at once
    try:
        server = MetricsServer(lambda: collect(graphs(), [folder]), port)
    except OSError as error:
        raise fail(f"cannot listen on port {port} of loopback: {error.strerror}") from None
    say(f"http://127.0.0.1:{server.port}/metrics")
    try:
        server.serve()
    except KeyboardInterrupt:
        raise typer.Exit(INTERRUPTED) from None


def _rates(words: Sequence[str], operators: Mapping[str, object]) -> dict[str, float]:
    from dataflow.graph.problems import did_you_mean

    found = {}
    for word in words:
        operator, _, number = word.rpartition("=")
        if operator not in operators:
            raise fail(
                f"--rate {word}: no operator {operator!r} runs: {did_you_mean(operator, operators, 'there are')}"
            )
        try:
            found[operator] = float(number)
        except ValueError:
            raise fail(f"--rate {word}: expected a number of Hz behind the '='") from None
    return found


def _disk(folder: Path, free: float) -> Iterator[str]:
    if not folder.exists():
        yield f"{folder} is not there"
    elif (left := shutil.disk_usage(folder).free) < free * 1e9:
        yield f"the disk of {folder} has {size(left)} left, less than {free:g} GB"
