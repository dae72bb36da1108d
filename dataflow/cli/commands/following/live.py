"""`dataflow list`, `echo`, `hz`: following graphs that run."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from rich.text import Text

from dataflow.cli.commands.completion import running_graphs, running_streams
from dataflow.cli.support.arguments import Json, chosen_streams
from dataflow.cli.support.options import argument, option
from dataflow.cli.support.output import (
    INTERRUPTED,
    count,
    fail,
    out,
    plural,
    print_json,
    print_json_line,
    say,
    seconds,
    table,
)

if TYPE_CHECKING:
    from rich.table import Table

    from dataflow.messages import Message
    from dataflow.transport import TapClient, TapMessage
    from dataflow.transport.registry import RunningGraph

Streams = Annotated[
    list[str] | None, argument("STREAM...", "Streams; wildcards work. Default: all.", autocompletion=running_streams)
]

GRAPH_VARIABLE = "DATAFLOW_GRAPH"
"""Environment variable: the running graph that is meant where `--graph` is not given."""
HISTORY = 2000
"""Messages of a stream over which its rates are taken, at most."""


@dataclass(frozen=True, slots=True)
class Running:
    """Names a running graph."""

    graph: Annotated[
        str | None,
        option(
            "--graph NAME",
            "Which running graph, by name or process number, when several run. Environment: DATAFLOW_GRAPH.",
            autocompletion=running_graphs,
        ),
    ] = None
    wait: Annotated[float, option("--wait SECONDS", "Wait so long for the graph to run.")] = 0.0

    def found(self) -> RunningGraph:
        """The running graph of that name, or the only one; prints a note if it has to wait. Raises `NotRunning`."""
        from dataflow.client.attach import NotRunning, find_running

        name = self.graph or os.environ.get(GRAPH_VARIABLE) or None
        if not 0 <= self.wait < 1e9:
            raise fail(f"--wait {self.wait:g}: expected seconds, 0 or more")
        try:
            return find_running(name)
        except NotRunning:
            if not self.wait:
                raise
        say(f"waiting up to {seconds(self.wait)} for {'a graph' if name is None else escape(name)} to run")
        return find_running(name, wait=self.wait)

    def followed(self) -> RunningGraph:
        """The same, which is named on standard error."""
        found = self.found()
        say_followed(found)
        return found


THE_ONLY = Running()


def say_followed(found: RunningGraph) -> None:
    """Prints which running graph a command follows."""
    say(f"following {escape(found.name)} (process {found.pid})")


@contextmanager
def tapped(streams: list[str] | None, which: Running) -> Iterator[tuple[RunningGraph, TapClient]]:
    """The running graph, and a lossy copy of those of its streams that were asked for."""
    from dataflow.client.attach import graph_of, tap

    found = which.followed()
    graph = graph_of(found)
    chosen = chosen_streams(streams, graph.streams, graph.namespace)
    with tap(found, [f"/{stream}" for stream in chosen] if streams else ["**"]) as client:
        yield found, client


def list_running(json: Json = False) -> None:
    """List the graphs that run on this machine, with their streams.

    Examples:

      dataflow list
      dataflow list --json
    """
    from dataflow.client.attach import graph_of
    from dataflow.transport.registry import running

    graphs = running()
    if json:
        print_json([_listed(found) for found in graphs])
        return
    if not graphs:
        say("no graph runs on this machine; start one with: dataflow run GRAPH")
        return
    for found in graphs:
        graph = graph_of(found)
        out.print(
            Text.assemble(
                (found.name, "bold"),
                f"  namespace {found.namespace}, process {found.pid}",
                f", running for {seconds(time.time() - found.started)}",
            )
        )
        streams = table("stream", "type", "subscribers")
        for stream in graph.streams.values():
            takers = ", ".join(f"{node.name}.{port}" for node, port in graph.consumers(stream.name))
            kind = " | ".join(stream.types) + (" (static)" if stream.static else "")
            streams.add_row(Text(graph.relative(stream.name)), Text(kind), Text(takers or "no subscribers"))
        out.print(streams)


def _listed(found: RunningGraph) -> dict[str, Any]:
    from dataflow.client.attach import graph_of

    graph = graph_of(found)
    return {
        "name": found.name,
        "namespace": found.namespace,
        "pid": found.pid,
        "endpoints": list(found.endpoints),
        "started": found.started,
        "operators": list(graph.nodes),
        "streams": {s.name: list(s.types) for s in graph.streams.values()},
    }


def echo(
    streams: Streams = None,
    limit: Annotated[int | None, option("--count -n N", "Stop after so many messages.")] = None,
    once: Annotated[bool, option("--once", "Stop after one message: --count 1.")] = False,
    fields: Annotated[
        list[str] | None, option("--field -f NAME", "Print this field alone; may be given several times.")
    ] = None,
    full: Annotated[bool, option("--full", "Print long arrays and lists whole.")] = False,
    which: Running = THE_ONLY,
    json: Annotated[bool, option("--json", "One JSON object a line: all data, numbers unrounded.")] = False,
) -> None:
    """Print the messages of a running graph, as they come.

    It never slows the graph: what is not printed in time is skipped, and counted at the end. Streams are named without
    the graph's namespace, or in full with a leading slash.

    Examples:

      dataflow echo odometry/odometry
      dataflow echo "camera/*" -n 10
      dataflow echo odometry/odometry --once --field position
      dataflow echo odometry/odometry --json | jq .position
    """
    from dataflow.client.attach import still_runs

    if limit is not None and limit < 1:
        raise fail(f"--count {limit}: expected 1 or more")
    if once:
        if limit not in (None, 1):
            raise fail(f"--once is --count 1; --count {limit} contradicts it")
        limit = 1
    with tapped(streams, which) as (found, client):
        printed = 0
        try:
            while limit is None or printed < limit:
                taken = client.take(timeout=0.25)
                if taken is None:
                    if not still_runs(found):
                        break
                    continue
                message = taken.decode().message
                if message is not None:
                    printed += 1
                    _print_message(taken.stream, message, fields, full=full, json=json)
        except KeyboardInterrupt:
            raise typer.Exit(INTERRUPTED) from None
        finally:
            if client.skipped:
                say(f"[dim]{plural(client.skipped, 'message')} skipped: they came faster than they were printed[/]")
    if limit is not None and printed < limit:
        raise fail(f"the graph ended after {plural(printed, 'message')}, {limit - printed:,} short of --count", code=1)


def _print_message(stream: str, message: Message, asked: list[str] | None, *, full: bool, json: bool) -> None:
    chosen = _chosen_fields(stream, message, asked)
    if json:
        values = {name: value for name, value in message.items() if name in chosen}
        line = {"stream": stream, "type": message.SCHEMA, **values}
        print_json_line(line)
        return
    from dataflow.messages.display.text import field_text
    from dataflow.sync.stamps import format_stamp

    out.print(Text.assemble((stream, "bold"), f"  {format_stamp(message.stamp)}  ", (message.SCHEMA, "dim")))
    fields = [(name, value) for name, value in message.items() if name != "stamp" and name in chosen]
    width = max((len(name) for name, _ in fields), default=0)
    for name, value in fields:
        out.print(Text.assemble(f"  {name:<{width}}  ", field_text(value, whole=full)), soft_wrap=True)


def _chosen_fields(stream: str, message: Message, asked: list[str] | None) -> set[str]:
    """The fields of a message to print: those asked for, besides its timestamp, or all that are not None."""
    from dataflow.graph.problems import did_you_mean

    if not asked:
        return {name for name, value in message.items() if value is not None}
    known = {name for name, _ in message.items()}
    for name in asked:
        if name not in known:
            hint = did_you_mean(name, sorted(known), "it has")
            raise fail(f"{stream} carries {message.SCHEMA}, which has no field {name!r}: {hint}")
    return {"stamp", *asked}


@dataclass(slots=True)
class _Rate:
    """Holds what was seen of one stream: arrival (s), stamp (ns), number in the stream and bytes of the latest
    messages."""

    seen: deque[tuple[float, int, int, int]] = field(default_factory=lambda: deque(maxlen=HISTORY))

    def forget_before(self, time: float) -> None:
        """Leaves out what arrived before, the newest message aside."""
        while len(self.seen) > 1 and self.seen[0][0] < time:
            self.seen.popleft()

    def row(self, stream: str) -> dict[str, Any]:
        (t0, s0, n0, _), (t1, s1, n1, _) = self.seen[0], self.seen[-1]
        made, clock, event = n1 - n0, t1 - t0, (s1 - s0) * 1e-9
        mean = sum(entry[3] for entry in self.seen) / len(self.seen)
        return {
            "stream": stream,
            "messages": n1 + 1,
            "hz_clock": made / clock if made and clock > 0 else None,
            "hz_event": made / event if made and event > 0 else None,
            "bytes": mean,
            "mb_per_s": mean * made / clock * 1e-6 if made and clock > 0 else None,
        }


def hz(
    streams: Streams = None,
    duration: Annotated[float | None, option("--seconds SECONDS", "Stop after so long.")] = None,
    window: Annotated[float | None, option("--window SECONDS", "Rates over the last so many seconds.")] = None,
    which: Running = THE_ONLY,
    json: Json = False,
) -> None:
    """Show the rates of a running graph's streams.

    By the clock, by event time (the timestamps), and the bandwidth; `total` counts since the graph began. Messages that
    are skipped here are counted all the same. Ends with the graph, after --seconds, or at Ctrl-C.

    Examples:

      dataflow hz
      dataflow hz "camera/*" --seconds 5
      dataflow hz camera/image --window 2
      dataflow hz --seconds 5 --json
    """
    if duration is not None and not 0 < duration < 1e9:
        raise fail(f"--seconds {duration:g}: expected seconds, more than 0")
    if window is not None and not 0 < window < 1e9:
        raise fail(f"--window {window:g}: expected seconds, more than 0")
    rates: dict[str, _Rate] = {}
    stopped = False
    with tapped(streams, which) as (found, client):
        deadline = None if duration is None else time.monotonic() + duration
        try:
            _measure(rates, found, client, deadline, window, shown=not json and out.is_terminal)
        except KeyboardInterrupt:
            stopped = True
    if json:
        print_json([rate.row(stream) for stream, rate in sorted(rates.items())])
    else:
        out.print(_rate_table(rates, found.namespace))
    if stopped:
        raise typer.Exit(INTERRUPTED)


def _measure(
    rates: dict[str, _Rate],
    found: RunningGraph,
    client: TapClient,
    deadline: float | None,
    window: float | None,
    *,
    shown: bool,
) -> None:
    """Takes messages into `rates` until the deadline or the end of the graph; `shown`: in a table that is renewed."""
    from rich.live import Live

    from dataflow.client.attach import still_runs

    due = 0.0
    with Live(console=out, auto_refresh=False, transient=True) if shown else nullcontext() as live:
        while deadline is None or time.monotonic() < deadline:
            taken = client.take(timeout=0.25)
            if taken is not None:
                _take_rate(rates, taken)
            elif not still_runs(found):
                return
            if window is not None:
                for rate in rates.values():
                    rate.forget_before(time.monotonic() - window)
            if live is not None and time.monotonic() >= due:
                due = time.monotonic() + 0.25
                live.update(_rate_table(rates, found.namespace), refresh=True)


def _take_rate(rates: dict[str, _Rate], taken: TapMessage) -> None:
    from dataflow.transport import Kind

    head = taken.head()
    if head.kind is Kind.MESSAGE:
        entry = (time.monotonic(), head.stamp, head.seq, len(taken.payload))
        rates.setdefault(taken.stream, _Rate()).seen.append(entry)


def _rate_table(rates: dict[str, _Rate], namespace: str) -> Table:
    numbers = ("total", "Hz", "Hz by stamp", "kB each", "MB/s")
    shown = table("stream", *numbers, right=numbers)
    for stream, rate in sorted(rates.items()):
        row = rate.row(stream)
        cells = (row["hz_clock"], row["hz_event"], row["bytes"] * 1e-3, row["mb_per_s"])
        texts = ("" if cell is None else f"{cell:,.2f}" for cell in cells)
        shown.add_row(Text(stream.removeprefix(f"{namespace}/")), count(row["messages"]), *texts)
    return shown
