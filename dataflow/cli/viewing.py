"""`dataflow view`: a recording, or a graph that runs."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.text import Text

from dataflow.cli.arguments import End, Overwrite, Start, chosen_streams, existing, output_file, span, window
from dataflow.cli.live import GraphName, Wait, running_graph
from dataflow.cli.output import DIFFERENT, err, fail, friendly_errors, out, plural, say, size

if TYPE_CHECKING:
    from dataflow.graph import Graph
    from dataflow.messages import Message
    from dataflow.recording import Recording
    from dataflow.transport import RunningGraph, TapClient
    from dataflow.view import Target, ViewerSink

LOOK_EVERY = 0.25
"""Seconds between two looks at the log of the graph that is followed."""


def view(
    recording: Annotated[
        Path | None,
        typer.Argument(metavar="RECORDING", help="A recording (.mcap). Without one: the running graph."),
    ] = None,
    to: Annotated[
        str,
        typer.Option(
            "--to",
            metavar="TARGET",
            help="spawn: a window; serve: a page for a browser; FILE.rrd: a file; or the address of a viewer that "
            "runs (rerun+http://127.0.0.1:9876/proxy).",
        ),
    ] = "spawn",
    streams: Annotated[
        list[str] | None,
        typer.Option("--stream", metavar="STREAM", help="Only these streams; wildcards work. May be repeated."),
    ] = None,
    start: Start = None,
    end: End = None,
    graph: GraphName = None,
    wait: Wait = 0.0,
    overwrite: Overwrite = False,
    modules: Annotated[
        list[str] | None,
        typer.Option("--import", metavar="MODULE", help="Import a module with visualisers first. May be repeated."),
    ] = None,
    until_end: Annotated[bool, typer.Option("--until-end", hidden=True)] = False,
) -> None:
    """Show a recording, or attach to a running graph.

    A viewer can never slow the graph: it skips what it cannot draw in time. A recording is shown whole.

    Examples:

      dataflow view run.mcap
      dataflow view run.mcap --to run.rrd --start 5 --end 10
      dataflow view run.mcap --to serve --stream "camera/*"
      dataflow view --graph rgbd_perception --to serve
    """
    with friendly_errors():
        _import(modules or ())
        if recording is not None:
            if graph is not None or wait:
                raise fail("--graph and --wait are about a running graph; leave them out to view a recording")
            _view_recording(existing(recording, "a recording"), _target(to, overwrite), streams, start, end)
        else:
            if start is not None or end is not None:
                raise fail("--start and --end are about a recording; name one")
            _view_running(_target(to, overwrite), streams, graph, wait, until_end=until_end)


def _import(modules: Iterable[str]) -> None:
    for name in modules:
        try:
            importlib.import_module(name)
        except (Exception, SystemExit) as error:  # a module may fail in any way when it runs
            raise fail(f"--import {name}: {type(error).__name__}: {error}") from error


def _target(to: str, overwrite: bool) -> Target:
    from dataflow.view import Save, Spawn, parse_target

    target = parse_target(to)
    if isinstance(target, Save):
        output_file(target.path, ".rrd", overwrite=overwrite, option="--to")
    if isinstance(target, Spawn):
        require_display()
    return target


def _sink(target: Target) -> ViewerSink:
    from dataflow.view import ViewerSink

    return ViewerSink(target, report=lambda line: say(f"[yellow]{escape(line)}[/]"))


def require_display() -> None:
    """An error, with what to use instead, where no window can be opened."""
    from dataflow.view.process import display_problem

    if (problem := display_problem()) is not None:
        raise fail(
            f"cannot open a viewer window: {problem}; use serve (a page for a browser) or a file name ending in .rrd"
        )


def _view_recording(
    path: Path, target: Target, streams: list[str] | None, start: float | None, end: float | None
) -> None:
    from rich.progress import BarColumn, Progress, TextColumn

    from dataflow.recording import Recording
    from dataflow.recording.layout import RECORDING
    from dataflow.reexecution.recorded_run import resolved_graph
    from dataflow.view import Serve, from_recording

    with Recording(path) as opened:
        readable = [name for name, info in opened.streams.items() if info.message_type is not None]
        if not readable:
            raise fail(f"{path} holds no stream that can be drawn; see: dataflow info {path}")
        namespace = opened.metadata.get(RECORDING, {}).get("namespace", "")
        chosen = chosen_streams(streams, readable, namespace)
        if not any(opened.streams[name].count for name in chosen):
            raise fail(f"{path} holds no message of {', '.join(chosen)}")
        graph = resolved_graph(opened)
        if graph is not None:
            graph = _showing(graph, streams and chosen)
        if generic := sorted({_type_name(opened, name) for name in chosen if opened.streams[name].generic}):
            say(f"[dim]drawn by the recording's own declaration, without its module: {', '.join(generic)}[/]")
        whole = span(opened, chosen)
        begin, finish = window(whole, start, end, path)
        first, last = whole or (0, 0)
        first, last = begin or first, last if finish is None else min(finish, last)
        with _sink(target) as sink:
            with Progress(
                TextColumn("drawing"), BarColumn(bar_width=24), TextColumn("{task.fields[note]}"), console=err,
                transient=True, disable=not err.is_terminal,
            ) as bar:  # fmt: skip
                task = bar.add_task("", total=max(last - first, 1), note="")

                def progress(stamp: int) -> None:
                    note = f"{(stamp - first) * 1e-9:.1f} of {(last - first) * 1e-9:.1f} s"
                    bar.update(task, completed=stamp - first, note=note)

                announcer = _Announcer(sink)
                handed = from_recording(
                    opened, sink, chosen, begin, finish, graph=graph, progress=announcer.before(progress)
                )
            announcer.announce()
            if isinstance(target, Serve):
                say(f"all {plural(handed, 'message')} sent; serving until Ctrl-C")
                _until_interrupted()
            complete = sink.close(timeout=60.0)
    _report(sink, complete)


def _type_name(opened: Recording, stream: str) -> str:
    found = opened.streams[stream].message_type
    return "" if found is None else found.SCHEMA


def _showing(graph: Graph, wanted: list[str] | None) -> Graph:
    """The graph, with those of its hidden streams shown that were asked for by name."""
    if not wanted:
        return graph
    return replace(graph, view=replace(graph.view, hide=tuple(s for s in graph.view.hide if s not in wanted)))


class _Announcer:
    """Says once, as soon as the viewer is reached, where to look."""

    def __init__(self, sink: ViewerSink) -> None:
        self._sink, self._done = sink, False

    def announce(self) -> None:
        from dataflow.view import Serve

        if not self._done and isinstance(self._sink.target, Serve):
            err.print(Text(f"open {self._sink.target.url}"), soft_wrap=True)  # whole, so that it can be clicked
        self._done = True

    def before(self, progress: Callable[[int], None]) -> Callable[[int], None]:
        def announced(stamp: int) -> None:
            self.announce()
            progress(stamp)

        return announced


def _view_running(target: Target, streams: list[str] | None, name: str | None, wait: float, *, until_end: bool) -> None:
    from dataflow.client.attach import graph_of, tap
    from dataflow.graph.sections import PLACE_FRAMES

    if wait:
        importlib.import_module("dataflow.view.sink")  # takes long; done when the graph begins, which may be short
    found = running_graph(name, wait)
    running = graph_of(found)
    chosen = chosen_streams(streams, running.streams, running.namespace)
    others = [name for name, stream in running.streams.items() if set(stream.types) & set(PLACE_FRAMES)]
    others = [name for name in others if name not in chosen]
    with tap(found, [f"/{name}" for name in (*chosen, *others)] if streams else ["**"]) as client:
        say(f"following {escape(running.name)} (process {found.pid})")
        _draw_running(target, client, found, running, chosen, others, logs=not streams, until_end=until_end)


def _draw_running(
    target: Target,
    client: TapClient,
    found: RunningGraph,
    running: Graph,
    chosen: list[str],
    others: list[str],
    *,
    logs: bool,
    until_end: bool,
) -> None:
    """Draws the streams that were chosen until the graph ends, and what it logs with them.

    `others` are not shown, but place frames.
    """
    from dataflow.client.attach import still_runs
    from dataflow.names import logs_key
    from dataflow.recording import LogLine
    from dataflow.transport.log_file import LogFollower
    from dataflow.view import Serve, as_alarm

    log_stream = logs_key(running.namespace)
    with _sink(target) as sink, closing(LogFollower(found.pid)) as follower:
        types = _types(running, [*chosen, *others], log_stream if logs else None)
        sink.open(types, _showing(running, None if logs else chosen), hidden=others)
        _Announcer(sink).announce()
        clock, look_due = 0, 0.0
        while True:
            taken = client.take(timeout=0.5)
            if logs and time.monotonic() >= look_due:
                look_due = time.monotonic() + LOOK_EVERY
                for value in follower.lines():
                    sink.log(log_stream, as_alarm(LogLine.from_json(value), clock))
            if taken is None:
                if not still_runs(found):
                    break
                continue
            envelope = taken.decode()
            if envelope.message is not None:
                clock = max(clock, envelope.message.stamp)
                sink.log(taken.stream, envelope.message)
        client.close()
        if isinstance(target, Serve) and not until_end:
            say("the graph has ended; still serving until Ctrl-C")
            _until_interrupted()
        complete = sink.close(timeout=60.0)
    _report(sink, complete)


def _types(running: Graph, chosen: list[str], logs: str | None) -> dict[str, type[Message]]:
    """The class that each stream is drawn as; `logs`: the stream of the lines that are logged, if they are drawn."""
    from dataflow.client.attach import types_of
    from dataflow.messages import Alarm, Message, MessageError

    for stream in chosen:
        try:
            running.message_types(stream)  # with the module come the visualisers of its types
        except MessageError as error:
            say(f"[yellow]{escape(str(error))}; drawn by its fields[/]")
    class_of = types_of(running)
    first = {name: running.streams[name].types[0] for name in chosen}
    drawn: dict[str, type[Message]] = {
        name: Message if schema == "Message" else class_of(schema) for name, schema in first.items()
    }
    return drawn if logs is None else drawn | {logs: Alarm}


def _report(sink: ViewerSink, complete: bool) -> None:
    from dataflow.view import Save

    drawn = sink.statistics()
    parts = [plural(drawn.drawn, "message")]
    if drawn.dropped:
        parts.append(f"{drawn.dropped:,} skipped because the viewer was too slow")
    if drawn.failed:
        parts.append(f"{drawn.failed:,} could not be drawn")
    if isinstance(sink.target, Save):
        path = sink.target.path
        out.print(f"wrote {escape(str(path))} ({', '.join(parts)}, {size(path.stat().st_size)})", soft_wrap=True)
    else:
        out.print(f"shown: {', '.join(parts)}")
    if not complete or drawn.failed:
        raise typer.Exit(DIFFERENT)


def _until_interrupted() -> None:
    try:
        while True:
            time.sleep(1.0)
    except KeyboardInterrupt:
        return
