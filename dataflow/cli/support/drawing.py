"""Draws a recording or a bag in a viewer, and prints what was drawn."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.markup import escape
from rich.text import Text

from dataflow.cli.support.arguments import Selection, refuse_of_recording, span, window
from dataflow.cli.support.output import DIFFERENT, err, fail, out, plural, say, size

if TYPE_CHECKING:
    from dataflow.graph import Graph
    from dataflow.interop.account import Account
    from dataflow.interop.clocks import Choice
    from dataflow.interop.streams import BagStreams
    from dataflow.recording import Recording
    from dataflow.view import Target, ViewerSink


@dataclass(frozen=True, slots=True)
class DrawingResult:
    """The viewer, closed; whether it took everything; and what there is to say of a bag."""

    sink: ViewerSink
    complete: bool
    account: Account


def draw_recording(
    path: Path, target: Target, asked: Selection, every: float | None = None, *, strict: bool = False
) -> DrawingResult:
    """Draws a recording or a bag. `strict`: what cannot be read of a bag is an error, else it is counted."""
    from rich.progress import BarColumn, Progress, TextColumn

    from dataflow.recording.layout import RECORDING
    from dataflow.view import Serve, from_recording

    with opened_streams(path, asked.clock, strict=strict) as opened:
        known = account_of(opened).lines()
        readable = [name for name, info in opened.streams.items() if info.message_type is not None]
        if not readable:
            raise fail(f"{path} holds no stream that can be drawn; see: dataflow info {path}")
        namespace = opened.metadata.get(RECORDING, {}).get("namespace", "")
        chosen = asked.of(readable, namespace)
        if not any(opened.streams[name].count for name in chosen):
            raise fail(f"{path} holds no message of {', '.join(chosen)}")
        graph = _graph_of(opened)
        if graph is not None:
            graph = showing(graph, asked.streams and chosen)
        if generic := sorted({_type_name(opened, name) for name in chosen if opened.streams[name].generic}):
            say(f"[dim]drawn by the recording's own declaration, without its module: {', '.join(generic)}[/]")
        whole = span(opened, chosen)
        begin, finish = window(whole, asked.start, asked.end, path)
        first, last = whole or (0, 0)
        first, last = begin or first, last if finish is None else min(finish, last)
        with open_sink(target, every) as sink:
            with Progress(
                TextColumn("drawing"), BarColumn(bar_width=24), TextColumn("{task.fields[note]}"), console=err,
                transient=True, disable=not err.is_terminal,
            ) as bar:  # fmt: skip
                task = bar.add_task("", total=max(last - first, 1), note="")

                def progress(stamp: int) -> None:
                    note = f"{(stamp - first) * 1e-9:.1f} of {(last - first) * 1e-9:.1f} s"
                    bar.update(task, completed=stamp - first, note=note)

                announcer = Announcer(sink)
                handed = from_recording(
                    opened, sink, chosen, begin, finish, graph=graph, progress=announcer.before(progress)
                )
            announcer.announce()
            if isinstance(target, Serve):
                say(f"all {plural(handed, 'message')} sent; serving until Ctrl-C")
                until_interrupted()
            complete = sink.close(timeout=60.0)
        say_account(opened, known)
        return DrawingResult(sink, complete, account_of(opened))


def opened_streams(path: Path, clock: Choice, *, strict: bool = False) -> Recording | BagStreams:
    """Opens a recording, or a bag with every topic that a message type fits; prints which clock its stamps are of."""
    from dataflow.interop.opening import is_foreign, open_bag
    from dataflow.recording import Recording

    if not is_foreign(path):
        refuse_of_recording(path, clock, strict=strict)
        return Recording(path)
    from dataflow.interop.playing import BagReadOptions, readable

    with closing(open_bag(path, strict=strict)) as bag:
        streams = readable(bag, path, clock, wishes=BagReadOptions(strict=strict))
    say(f"[dim]stamps: {escape(streams.clock.kind)}: {escape(streams.clock.why)}[/]")
    say_account(streams)
    return streams


def say_account(opened: Recording | BagStreams, but: Collection[str] = ()) -> None:
    """Prints what was found of a bag, except the lines that are known; some comes to light when messages are read."""
    from dataflow.recording import Recording

    if isinstance(opened, Recording):
        return
    found = account_of(opened).lines()
    for line in found:
        if line not in but:
            say(f"[yellow]{escape(line)}[/]")


def account_of(opened: Recording | BagStreams) -> Account:
    from dataflow.interop.account import Account
    from dataflow.recording import Recording

    if isinstance(opened, Recording):
        return Account([f"{opened.path.name}: {what}" for what in opened.damage], list(opened.lacking))
    opened.recount()
    return opened.account


def _graph_of(opened: Recording | BagStreams) -> Graph | None:
    from dataflow.recording import Recording
    from dataflow.reexecution.recorded_run import resolved_graph

    return resolved_graph(opened) if isinstance(opened, Recording) else None


def _type_name(opened: Recording | BagStreams, stream: str) -> str:
    found = opened.streams[stream].message_type
    return "" if found is None else found.SCHEMA


def showing(graph: Graph, wanted: list[str] | None) -> Graph:
    """The graph, with those of its hidden streams shown that were asked for by name."""
    if not wanted:
        return graph
    return replace(graph, view=replace(graph.view, hide=tuple(s for s in graph.view.hide if s not in wanted)))


def open_sink(target: Target, every: float | None = None) -> ViewerSink:
    """The viewer. `every`: seconds of event time in which one image of each stream is drawn into a file."""
    from dataflow.view import Save, ViewerSink
    from dataflow.view.sink import FILE_OPTIONS

    if every is not None and not isinstance(target, Save):
        raise fail("--every is about a viewer file (--to FILE.rrd); elsewhere every message is drawn")
    if every is not None and not every >= 0:
        raise fail(f"--every {every:g}: expected a duration of 0 or more")
    options = None if every is None else replace(FILE_OPTIONS, image_step=round(every * 1e9))
    return ViewerSink(target, options=options, report=lambda line: say(f"[yellow]{escape(line)}[/]"))


class Announcer:
    """Prints once, as soon as the viewer is reached, where to look."""

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


def report(done: DrawingResult, file: Path | None = None) -> None:
    """Prints how much was drawn, and where it is: in `file`, if it was moved there."""
    from dataflow.view import Save

    sink, drawn = done.sink, done.sink.statistics()
    parts = [plural(drawn.drawn, "message")]
    if drawn.dropped:
        parts.append(f"{drawn.dropped:,} skipped because the viewer was too slow")
    if drawn.passed:
        parts.append(f"{drawn.passed:,} passed over: images beyond the rate that --every of `dataflow view` sets")
    if drawn.failed:
        parts.append(f"{drawn.failed:,} could not be drawn")
    if isinstance(sink.target, Save):
        path = file or sink.target.path
        out.print(f"wrote {escape(str(path))} ({', '.join(parts)}, {size(path.stat().st_size)})", soft_wrap=True)
    else:
        out.print(f"shown: {', '.join(parts)}")
    if not done.complete or drawn.failed or done.account.short:
        raise typer.Exit(DIFFERENT)


def drawn_as_json(sink: ViewerSink, file: Path) -> dict[str, Any]:
    """Returns JSON values that say how much a viewer file holds."""
    counts = sink.statistics()
    return {"files": [str(file)], "messages": counts.drawn, "not_drawn": counts.failed}


def until_interrupted() -> None:
    try:
        while True:
            time.sleep(1.0)
    except KeyboardInterrupt:
        return
