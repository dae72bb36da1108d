"""`dataflow view`: a recording, or a graph that runs."""

from __future__ import annotations

import importlib
import time
from collections.abc import Iterable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from dataflow.cli.commands.following.live import THE_ONLY, Running, say_followed
from dataflow.cli.support.arguments import (
    ALL,
    Every,
    Overwrite,
    Selection,
    chosen_streams,
    existing_recording,
    output_file,
)
from dataflow.cli.support.drawing import (
    Announcer,
    DrawingResult,
    draw_recording,
    open_sink,
    report,
    showing,
    until_interrupted,
)
from dataflow.cli.support.options import argument, option
from dataflow.cli.support.output import fail, say
from dataflow.cli.support.viewers import require_display

if TYPE_CHECKING:
    from dataflow.graph import Graph
    from dataflow.messages import Message
    from dataflow.transport import RunningGraph, TapClient
    from dataflow.transport.log_file import LogFollower
    from dataflow.view import Target, ViewerSink

LOOK_EVERY = 0.25
"""Seconds between two looks at the log of the graph that is followed."""


def view(
    recording: Annotated[
        Path | None,
        argument(
            "RECORDING", "A recording (.mcap), or a bag: .bag, .db3, .mcap or a folder. Without one: the running graph."
        ),
    ] = None,
    to: Annotated[
        str,
        option(
            "--to --out -o TARGET",
            "spawn: a window; serve: a page for a browser; FILE.rrd: a file; or the address of a viewer that "
            "runs (rerun+http://127.0.0.1:9876/proxy).",
        ),
    ] = "spawn",
    asked: Selection = ALL,
    which: Running = THE_ONLY,
    every: Every = None,
    overwrite: Overwrite = False,
    modules: Annotated[
        list[str] | None, option("--import MODULE", "Import a module with visualisers first. May be repeated.")
    ] = None,
    until_end: Annotated[bool, typer.Option("--until-end", hidden=True)] = False,
) -> None:
    """Show a recording or a bag, or attach to a running graph.

    A viewer can never slow the graph: it skips what it cannot draw in time. A recording is shown whole.

    Examples:

      dataflow view run.mcap
      dataflow view run.mcap --to run.rrd --start 5 --end 10
      dataflow view run.mcap --to run.rrd --every 0
      dataflow view run.mcap --to serve --stream "camera/*"
      dataflow view drive.bag --to drive.rrd
      dataflow view --graph rgbd_perception --to serve
    """
    _import(modules or ())
    if recording is not None:
        if which != THE_ONLY:
            raise fail("--graph and --wait are about a running graph; leave them out to view a recording")
        path = existing_recording(recording)
        report(draw_recording(path, _target(to, overwrite), asked, every))
    else:
        if replace(asked, streams=None, without=asked.without or None) != ALL:
            raise fail("--start, --end, --without and --clock are about a recording; name one")
        _view_running(_target(to, overwrite), asked.streams, which, every, until_end=until_end)


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


def _view_running(
    target: Target, streams: list[str] | None, which: Running, every: float | None, *, until_end: bool
) -> None:
    """Draws streams of a graph until it ends; all of them with what it logs, if none are named."""
    from dataflow.client.attach import graph_of, tap
    from dataflow.graph.sections import PLACE_FRAMES
    from dataflow.interop.account import Account
    from dataflow.names import logs_key
    from dataflow.transport.log_file import LogFollower
    from dataflow.view import Serve

    if which.wait:
        importlib.import_module("dataflow.view.sink")  # takes long; done when the graph begins, which may be short
    found = which.found()
    running = graph_of(found)
    chosen, logs = chosen_streams(streams, running.streams, running.namespace), not streams
    others = [name for name, stream in running.streams.items() if set(stream.types) & set(PLACE_FRAMES)]
    others = [name for name in others if name not in chosen]  # not shown, but place frames
    with tap(found, [f"/{name}" for name in (*chosen, *others)] if streams else ["**"]) as client:
        say_followed(found)
        with open_sink(target, every) as sink, closing(LogFollower(found.pid)) as follower:
            types = _types(running, [*chosen, *others], logs_key(running.namespace) if logs else None)
            sink.open(types, showing(running, None if logs else chosen), hidden=others)
            Announcer(sink).announce()
            _draw_running(sink, client, found, follower if logs else None, logs_key(running.namespace))
            client.close()
            if isinstance(target, Serve) and not until_end:
                say("the graph has ended; still serving until Ctrl-C")
                until_interrupted()
            complete = sink.close(timeout=60.0)
    report(DrawingResult(sink, complete, Account()))


def _draw_running(
    sink: ViewerSink, client: TapClient, found: RunningGraph, follower: LogFollower | None, log_stream: str
) -> None:
    """Draws what comes, and the log if it is followed, until the graph ends."""
    from dataflow.client.attach import still_runs
    from dataflow.recording import LogLine
    from dataflow.view import as_alarm

    clock, look_due = 0, 0.0
    while True:
        taken = client.take(timeout=0.5)
        if follower is not None and time.monotonic() >= look_due:
            look_due = time.monotonic() + LOOK_EVERY
            for value in follower.lines():
                sink.log(log_stream, as_alarm(LogLine.from_json(value), clock))
        if taken is not None and (message := taken.decode().message) is not None:
            clock = max(clock, message.stamp)
            sink.log(taken.stream, message)
        elif taken is None and not still_runs(found):
            return


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
