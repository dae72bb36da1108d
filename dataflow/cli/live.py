"""`dataflow list`, `echo`, `hz`, `view`: following graphs that run, and looking at recordings."""

from __future__ import annotations

import time
from collections import defaultdict, deque
from pathlib import Path
from typing import Annotated, Any

import typer

from dataflow.cli.execution import Json
from dataflow.cli.output import err, fail, friendly_errors, out, print_json

GraphName = Annotated[
    str | None, typer.Option("--graph", metavar="NAME", help="Which running graph, when several run.")
]
Wait = Annotated[float, typer.Option("--wait", min=0, help="Seconds to wait for the graph to run.")]
Keys = Annotated[list[str] | None, typer.Argument(metavar="[STREAM]...", help="Streams: camera/image, camera/*, **.")]


def list_running(json: Json = False) -> None:
    """List the graphs that run on this machine, their operators and streams.

    \b
    dataflow list
    """
    from rich.table import Table

    from dataflow.runtime.attach import graph_of
    from dataflow.transport.registry import running

    graphs = running()
    if json:
        print_json(
            [
                {
                    "name": g.name,
                    "namespace": g.namespace,
                    "pid": g.pid,
                    "started": g.started,
                    "operators": list(graph_of(g).nodes),
                    "streams": {s.name: list(s.types) for s in graph_of(g).streams.values()},
                }
                for g in graphs
            ]
        )
        return
    if not graphs:
        out.print("no graph runs on this machine; start one with: dataflow run GRAPH")
        return
    for found in graphs:
        graph = graph_of(found)
        table = Table(
            title=f"{found.name}  process {found.pid}, running for {time.time() - found.started:.0f} s",
            title_justify="left",
        )
        for column in ("stream", "type", "from", "taken by"):
            table.add_column(column)
        for stream in graph.streams.values():
            takers = ", ".join(f"{node.name}.{port}" for node, port in graph.consumers(stream.name))
            kind = " | ".join(stream.types) + (" (static)" if stream.static else "")
            table.add_row(graph.relative(stream.name), kind, stream.node, takers)
        out.print(table)


def echo(
    streams: Keys = None,
    graph: GraphName = None,
    count: Annotated[int | None, typer.Option("--count", "-n", min=1, help="Stop after so many messages.")] = None,
    full: Annotated[bool, typer.Option("--full", help="Print array contents, not only their shapes.")] = False,
    wait: Wait = 0.0,
    json: Json = False,
) -> None:
    """Print the messages of a running graph, as they come. Never slows the graph; may skip messages.

    \b
    dataflow echo odometry/odometry
    dataflow echo "camera/*" -n 10 --json
    """
    from dataflow.runtime.attach import find_running, still_runs, tap

    with friendly_errors():
        found = _found(find_running, graph, wait)
        printed = 0
        with tap(found, streams or ["**"]) as client:
            while count is None or printed < count:
                taken = client.take(timeout=0.5)
                if taken is None:
                    if not still_runs(found):
                        break
                    continue
                envelope = taken.decode()
                if envelope.message is None:
                    continue
                printed += 1
                _print_message(taken.stream, envelope.message, full=full, json=json)
            skipped = client.skipped
        if skipped:
            err.print(f"[dim]{skipped} messages were skipped: the graph made them faster than they were printed[/]")


def _print_message(stream: str, message: Any, *, full: bool, json: bool) -> None:
    import json as json_module

    import numpy as np

    values: dict[str, Any] = {}
    for name, value in message.items():
        if isinstance(value, np.ndarray):
            small = full or value.size <= 16
            values[name] = value.tolist() if small else f"{value.dtype}{list(value.shape)}"
        elif value is not None:
            values[name] = value
    if json:
        print(json_module.dumps({"stream": stream, "type": message.SCHEMA, **values}, ensure_ascii=False), flush=True)
    else:
        out.print(f"[bold]{stream}[/] [dim]{message.SCHEMA}[/]")
        for name, value in values.items():
            out.print(f"  {name}: {value}", markup=False, soft_wrap=True)


def hz(
    streams: Keys = None,
    graph: GraphName = None,
    seconds: Annotated[float | None, typer.Option("--seconds", min=0.1, help="Stop after so long.")] = None,
    wait: Wait = 0.0,
    json: Json = False,
) -> None:
    """Show the rates of a running graph's streams: by the clock, by event time, and the bandwidth.

    \b
    dataflow hz
    dataflow hz "camera/*" --seconds 5
    """
    from rich.live import Live
    from rich.table import Table

    from dataflow.runtime.attach import find_running, still_runs, tap
    from dataflow.transport import Kind

    seen: dict[str, deque[tuple[float, int, int, int]]] = defaultdict(lambda: deque(maxlen=500))

    def rows() -> list[dict[str, Any]]:
        result = []
        for stream, times in sorted(seen.items()):
            clock = times[-1][0] - times[0][0]
            event = (times[-1][1] - times[0][1]) * 1e-9
            made = times[-1][2] - times[0][2]
            nbytes = sum(t[3] for t in list(times)[1:])
            shown = max(len(times) - 1, 1)
            result.append(
                {
                    "stream": stream,
                    "messages": times[-1][2] + 1,
                    "hz_clock": made / clock if clock > 0 else None,
                    "hz_event": made / event if event > 0 else None,
                    "mb_per_s": nbytes / shown * made / clock * 1e-6 if clock > 0 else None,
                }
            )
        return result

    def table() -> Table:
        shown = Table()
        shown.add_column("stream")
        for column in ("messages", "Hz", "Hz (event time)", "MB/s"):
            shown.add_column(column, justify="right")
        for row in rows():
            cells = (row["hz_clock"], row["hz_event"], row["mb_per_s"])
            shown.add_row(row["stream"], str(row["messages"]), *("–" if c is None else f"{c:.2f}" for c in cells))
        return shown

    with friendly_errors():
        found = _found(find_running, graph, wait)
        deadline = None if seconds is None else time.monotonic() + seconds
        with tap(found, streams or ["**"]) as client:
            live = None if json or not out.is_terminal else Live(console=out, refresh_per_second=4)
            if live is not None:
                live.start()
            try:
                while deadline is None or time.monotonic() < deadline:
                    taken = client.take(timeout=0.25)
                    if taken is None:
                        if not still_runs(found):
                            break
                    else:
                        head = taken.head()
                        if head.kind is Kind.MESSAGE:
                            seen[taken.stream].append((time.monotonic(), head.stamp, head.seq, len(taken.payload)))
                    if live is not None:
                        live.update(table())
            finally:
                if live is not None:
                    live.stop()
        if json:
            print_json(rows())
        elif live is None:
            out.print(table())


def view(
    recording: Annotated[Path | None, typer.Argument(help="A recording. Without one: the running graph.")] = None,
    to: Annotated[
        str, typer.Option("--to", metavar="spawn|serve|URL|FILE.rrd", help="Where to show it.")
    ] = "spawn",
    streams: Annotated[list[str] | None, typer.Option("--stream", help="Only these streams. May be repeated.")] = None,
    start: Annotated[float | None, typer.Option(min=0, help="Seconds from the first message.")] = None,
    end: Annotated[float | None, typer.Option(min=0, help="Seconds from the first message.")] = None,
    graph: GraphName = None,
    wait: Wait = 0.0,
) -> None:
    """Show a recording, or attach to a running graph. A viewer can never slow the graph.

    \b
    dataflow view recordings/demo.mcap
    dataflow view recordings/demo.mcap --to demo.rrd
    dataflow view --graph rgbd_perception --to serve
    """
    from dataflow.view import ViewerError, ViewerSink, parse_target

    with friendly_errors():
        try:
            target = parse_target(to)
            sink = ViewerSink(target)
            if recording is not None:
                _view_recording(recording, sink, streams, start, end)
            else:
                _view_running(sink, streams, graph, wait)
        except ViewerError as error:
            raise fail(str(error)) from None


def _announce(sink: Any) -> None:
    from dataflow.view import Serve

    if isinstance(sink.target, Serve):
        err.print(f"open {sink.target.url}", soft_wrap=True)


def _view_recording(
    path: Path, sink: Any, streams: list[str] | None, start: float | None, end: float | None
) -> None:
    from rich.progress import Progress

    from dataflow.recording import Recording
    from dataflow.runtime.replay import ReplayError, recorded_graph
    from dataflow.view import Serve, from_recording

    with Recording(path) as opened:
        try:
            graph = recorded_graph(opened)
        except ReplayError:
            graph = None
        known = {name: i.message_type for name, i in opened.streams.items() if i.message_type is not None}
        chosen = _chosen(list(known), streams)
        static = [name for name in chosen if opened.streams[name].static]
        moving = [i for name, i in opened.streams.items() if name in chosen and not i.static]
        first = min((i.first for i in moving if i.first is not None), default=0)
        last = max((i.last for i in moving if i.last is not None), default=0)
        begin = None if start is None else first + round(start * 1e9)
        finish = None if end is None else first + round(end * 1e9)
        sink.open({name: known[name] for name in chosen}, graph, static)
        try:
            _announce(sink)
            with Progress(console=err, transient=True) as bar:
                task = bar.add_task("drawing", total=((finish or last) - (begin or first)) * 1e-9)
                drawn = from_recording(
                    opened,
                    sink,
                    chosen,
                    begin,
                    finish,
                    progress=lambda stamp: bar.update(task, completed=(stamp - (begin or first)) * 1e-9),
                )
            if isinstance(sink.target, Serve):
                err.print("serving; stop with Ctrl-C")
                _until_interrupted()
        finally:
            sink.close()
    err.print(f"{drawn:,} messages")


def _view_running(sink: Any, streams: list[str] | None, graph: str | None, wait: float) -> None:
    from dataflow.messages import message_type
    from dataflow.runtime.attach import find_running, graph_of, still_runs, tap
    from dataflow.view import Serve

    found = _found(find_running, graph, wait)
    running = graph_of(found)
    chosen = _chosen(list(running.streams), streams)
    sink.open({name: message_type(running.streams[name].types[0]) for name in chosen}, running)
    try:
        _announce(sink)
        with tap(found, [f"/{name}" for name in chosen]) as client:
            while True:
                taken = client.take(timeout=0.5)
                if taken is None:
                    if not still_runs(found):
                        break
                    continue
                envelope = taken.decode()
                if envelope.message is not None:
                    sink.log(taken.stream, envelope.message)
        if isinstance(sink.target, Serve):
            err.print("the graph has ended; still serving; stop with Ctrl-C")
            _until_interrupted()
    finally:
        sink.close()


def _chosen(known: list[str], wanted: list[str] | None) -> list[str]:
    if not wanted:
        return known
    chosen = [name for name in known if any(name == w or name.endswith(f"/{w}") for w in wanted)]
    missing = [w for w in wanted if not any(name == w or name.endswith(f"/{w}") for name in known)]
    if missing:
        raise fail(f"no stream {missing[0]!r}; there are: {', '.join(known)}")
    return chosen


def _found(find: Any, graph: str | None, wait: float) -> Any:
    from dataflow.runtime.attach import NotRunning

    try:
        return find(graph, wait=wait)
    except NotRunning as error:
        raise fail(str(error)) from None


def _until_interrupted() -> None:
    try:
        while True:
            time.sleep(1.0)
    except KeyboardInterrupt:
        return
