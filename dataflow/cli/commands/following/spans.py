"""`dataflow spans`: the firings of a recording, or of a graph that runs, as spans of OpenTelemetry."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from dataflow.cli.commands.following.live import THE_ONLY, Running
from dataflow.cli.support.arguments import ModuleFolders, Overwrite, existing_recording, find_modules_in, output_file
from dataflow.cli.support.options import argument, option
from dataflow.cli.support.output import INTERRUPTED, count, fail, say

if TYPE_CHECKING:
    from dataflow.client.span_sender import SpanSender
    from dataflow.transport.registry import RunningGraph

ANSWER_WITHIN = 1.0
CONNECT_WITHIN = 3.0
LEAST, MOST = 0.1, 0.5
"""Seconds between two requests to the processes of a graph."""
FULL = 0.4
"""Share of the firings which a process keeps that are to be new at a request."""
DRAIN_WITHIN = 10.0
NOTE_EVERY = 10.0


def spans(
    recording: Annotated[
        Path | None, argument("RECORDING", "A recording (.mcap). Without one: the running graph.")
    ] = None,
    to: Annotated[
        str,
        option(
            "--to --out -o TARGET", "FILE.jsonl, or the URL of a collector (http://127.0.0.1:4318).", show_default=False
        ),
    ] = "",
    folders: ModuleFolders = None,
    which: Running = THE_ONLY,
    overwrite: Overwrite = False,
) -> None:
    """Give every firing as a span of OpenTelemetry, to a file or a collector (OTLP in JSON over HTTP).

    A trace begins with a source's message; a firing is a child of the one whose message triggered it. A file is what a
    collector reads by its receiver `otlpjsonfile`.

    Of a running graph they are the last ones and those that come, until it ends or Ctrl-C. Its operators do nothing for
    it: each process keeps its last firings, which this command asks for. Firings that it asks for too late and spans
    that the collector does not take are counted, and named at the end. The firings of the last half second of a run may
    be missing; its recording has them.

    Examples:

      dataflow spans run.mcap --to run.jsonl
      dataflow spans --to http://127.0.0.1:4318
      dataflow spans --graph robot --wait 30 --to robot.jsonl
    """
    if recording is not None and which != THE_ONLY:
        raise fail("--graph and --wait are about a running graph; leave them out for a recording")
    find_modules_in(folders)
    write = _target(to, overwrite)
    if recording is not None:
        _export(recording, write, to)
    else:
        _follow(which.followed(), write, to)


def _target(to: str, overwrite: bool) -> Callable[[str], int]:
    from dataflow.client.span_sender import into_file, to_collector

    if "://" in to:
        return to_collector(to)
    if not to:
        raise fail("--to names where spans go: FILE.jsonl, or the URL of a collector")
    return into_file(output_file(Path(to), ".jsonl", overwrite=overwrite, option="--to"))


def _export(recording: Path, write: Callable[[str], int], to: str) -> None:
    from dataflow.analysis.latency import records_of
    from dataflow.analysis.spans import Spans
    from dataflow.client.span_sender import SpansRejected
    from dataflow.recording import Recording
    from dataflow.reexecution.recorded_run import recorded_graph, resolved_graph

    sent = lost = 0
    with Recording(existing_recording(recording)) as opened:
        if not opened.firing_batches():
            raise fail(
                f"{recording} holds no firing records, which become spans: `dataflow run --record` and replays keep "
                "them; `dataflow record`, conversions and other programs do not"
            )
        graph = resolved_graph(opened) or recorded_graph(opened)
        for line in Spans(graph).lines(records_of(opened, graph)):
            try:
                refused = write(line.text)
            except (OSError, SpansRejected) as error:
                raise fail(f"{to}: {getattr(error, 'reason', None) or error}; {count(sent)} spans were sent") from None
            sent, lost = sent + line.spans - refused, lost + refused
    say(f"{count(sent)} spans to {escape(to)}" + (f"; {count(lost)} were refused" if lost else ""))


def _follow(found: RunningGraph, write: Callable[[str], int], to: str) -> None:
    from dataflow.client.span_sender import SpanSender

    sender, missed, interrupted, noted = SpanSender(write), 0, False, float("-inf")
    try:
        for missed in _sent(found, sender):
            if (losses := _losses(sender, missed)) and time.monotonic() - noted >= NOTE_EVERY:
                noted = time.monotonic()
                say(f"[yellow]{escape(losses)} so far[/]")
    except KeyboardInterrupt:
        interrupted = True
    sender.close(DRAIN_WITHIN)
    say(f"{count(sender.sent)} spans to {escape(to)}; {_losses(sender, missed) or 'none lost'}")
    if sender.lost and not sender.sent:
        raise fail(f"{to} took no span: {sender.reason}")
    if interrupted:
        raise typer.Exit(INTERRUPTED)


def _sent(found: RunningGraph, sender: SpanSender) -> Iterator[int]:
    """Gives the sender the spans of a graph until it ends; yields how many firings were missed so far, at each
    request."""
    from dataflow.analysis.spans import Spans
    from dataflow.client.attach import graph_of, still_runs
    from dataflow.client.processes import processes_of
    from dataflow.records.firing import decode_batch

    spans, pause, missed = Spans(graph_of(found), whole=False), LEAST, 0
    cursors: dict[str, Any] = {}
    try:
        with processes_of(found) as processes:
            processes.connected(len(found.endpoints), CONNECT_WITHIN)
            runs = True
            while runs:
                runs = still_runs(found)
                records: dict[str, list[Any]] = {}
                full = 0.0
                for status in processes.statuses(ANSWER_WITHIN, after=cursors):
                    answer: Mapping[str, Any] = status.after
                    if not answer:
                        continue
                    for batch in map(decode_batch, answer["batches"]):
                        records.setdefault(batch.operator, []).extend(batch.records)
                    cursors[status.process] = answer["cursor"]
                    missed, full = missed + answer["missed"], max(full, answer["full"])
                for line in spans.round(records):
                    sender.put(*line)
                yield missed
                pause = min(MOST, max(LEAST, pause * min(2.0, FULL / full if full else 2.0)))
                time.sleep(pause if runs else 0)
    finally:
        for line in spans.rest():
            sender.put(*line)


def _losses(sender: SpanSender, missed: int) -> str:
    late = f"{count(missed)} firings were asked for too late" if missed else ""
    lost = f"{count(sender.lost)} spans lost ({sender.reason})" if sender.lost else ""
    return ", ".join(filter(None, (late, lost)))
