"""`dataflow record`, `trigger`: a recording of a running graph, and its flight recorder's history."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.markup import escape
from rich.text import Text

from dataflow.cli.commands.following.live import THE_ONLY, Running, Streams, say_followed
from dataflow.cli.support.arguments import Json, Overwrite, chosen_streams
from dataflow.cli.support.edited_files import Compression
from dataflow.cli.support.options import argument, option
from dataflow.cli.support.output import count, err, fail, out, plural, print_json, say, seconds, size, table
from dataflow.cli.support.storage import MODES, Readable, SplitEvery, SplitSize, named, recording_file, splitting_of

if TYPE_CHECKING:
    from dataflow.client.recorder import Tally
    from dataflow.graph import Graph
    from dataflow.transport.registry import RunningGraph


def record(
    streams: Streams = None,
    output: Annotated[Path, option("--out -o OUT.mcap", "The file to write; NAME_000.mcap and so on if split.")] = Path(
        "recording.mcap"
    ),
    split_every: SplitEvery = None,
    split_size: SplitSize = None,
    readable: Readable = "owner",
    compression: Compression = "zstd",
    duration: Annotated[float | None, option("--seconds SECONDS", "Stop after so long.")] = None,
    which: Running = THE_ONLY,
    overwrite: Overwrite = False,
    quiet: Annotated[bool, option("--quiet -q", "Show no progress.")] = False,
    json: Json = False,
) -> None:
    """Record streams of a graph that runs already.

    It is a plain subscriber: it comes and goes, and gets what is published meanwhile. So the recording holds no firing
    records: it replays, and cannot be verified. For that, run the graph with --record. Messages missed since
    the first one of a stream are counted by their numbers. A live run is not slowed down; any other waits for it.

    It ends with the graph, after --seconds, or at Ctrl-C; the file is complete in each case.

    Exit codes:

      0    written; 1: as far as it came, when another machine was not heard for 30 s
      2    could not record: no graph runs, a wrong option

    Examples:

      dataflow record -o run.mcap
      dataflow record "camera/*" imu/imu -o sensors.mcap
      dataflow record --split-every 60s -o drive.mcap
      dataflow record --split-size 500MB --seconds 600 -o drive.mcap
    """
    from dataflow.client.attach import graph_of
    from dataflow.client.recorder import AttachedRecorder, subscribed
    from dataflow.client.recorder import record as write

    splitting = splitting_of(split_every, split_size)
    if duration is not None and not 0 < duration < 1e9:
        raise fail(f"--seconds {duration:g}: expected seconds, more than 0")
    output = recording_file(named(output), splitting, overwrite=overwrite, option="--out")
    found = which.found()
    if not quiet:
        say_followed(found)
    running = graph_of(found)
    chosen = chosen_streams(streams, running.streams, running.namespace)
    made = partial(AttachedRecorder, splitting=splitting, compression=compression, mode=MODES[readable])
    with (
        subscribed(found, chosen) as subscription,
        made(output, running, chosen, metadata=_metadata(running), overwrite=overwrite) as recorder,
        _shown(recorder.tally, quiet or json) as show,
    ):
        write(subscription, recorder, goes_on=_until_over(found, duration, show))
    _report(recorder.tally, json=json)


def _metadata(running: Graph) -> dict[str, dict[str, str]]:
    from dataflow.reexecution.recorded_run import graph_metadata

    about = {"mode": "recorded from outside", "started": str(time.time_ns())}
    return {**graph_metadata(running), "dataflow:run": about}


def _until_over(found: RunningGraph, duration: float | None, show: Callable[[], None]) -> Iterator[bool]:
    """Yields whether to go on, until the graph has ended, the time is up, or an interrupt asks for the end."""
    from dataflow.client.attach import still_runs
    from dataflow.supervision.interrupts import interrupts

    stopped: list[bool] = []
    deadline = None if duration is None else time.monotonic() + duration
    look = time.monotonic() + 0.5
    with interrupts(lambda: stopped.append(True)):
        while not stopped and (deadline is None or time.monotonic() < deadline):
            if time.monotonic() >= look:
                look = time.monotonic() + 0.5
                show()
                if not still_runs(found):
                    return
            yield True


@contextmanager
def _shown(tally: Tally, hidden: bool) -> Iterator[Callable[[], None]]:
    if hidden or not err.is_terminal:
        yield lambda: None
        return
    with err.status("recording · Ctrl-C ends") as status:

        def show() -> None:
            missed = f" · {count(sum(tally.missed.values()))} missed" if tally.missed else ""
            total = sum(tally.messages.values())
            status.update(f"recording · {count(total)} messages · {size(tally.bytes)}{missed} · Ctrl-C ends")

        yield show


def _report(tally: Tally, *, json: bool) -> None:
    if json:
        print_json(tally.as_json())
        return
    made = table("stream", "messages", "missed", right=("messages", "missed"))
    for name, number in sorted(tally.messages.items()):
        made.add_row(Text(name), count(number), count(tally.missed[name]) if name in tally.missed else "")
    out.print(made)
    if tally.missed:
        say(f"[yellow]missed:[/] {plural(sum(tally.missed.values()), 'message')} came faster than they were taken")
    if tally.refused:
        say(f"[yellow]left out:[/] {plural(tally.refused, 'envelope')} that could not be read or came out of order")
    say("[dim]without firing records: it replays, and cannot be verified[/]")
    for file in tally.files:
        out.print(f"wrote {escape(file)}", soft_wrap=True)


def trigger(
    text: Annotated[str, argument("TEXT", "Why; it goes into the recording.")] = "asked for",
    which: Running = THE_ONLY,
    json: Json = False,
) -> None:
    """Save the flight recorder's history.

    A graph has a flight recorder with `record: {keep: 60s, after: 10s}`, if it runs without --record: a ring of files
    holds the last 60 s. The saved recording appears in its folder (`folder:`, by default `flight`) when `after` is
    over.

    Exit codes:

      0    asked
      2    no graph runs, or it has no flight recorder

    Examples:

      dataflow trigger
      dataflow trigger "nearly hit the door" --graph kitchen
    """
    from dataflow.client.attach import graph_of
    from dataflow.client.trigger import trigger as ask

    found = which.found()
    ask(found, text)
    flight = graph_of(found).record.flight
    assert flight is not None
    if json:
        print_json({"graph": found.name, "text": text, "folder": flight.folder, "keep": flight.keep})
        return
    kept, after = seconds(flight.keep * 1e-9), seconds(flight.after * 1e-9)
    out.print(f"keeps the last {kept} and the next {after} in {escape(flight.folder)}", soft_wrap=True)
