"""Bags of other systems on the command line: replayed through a graph, described."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.markup import escape
from rich.text import Text

from dataflow.cli.support.arguments import span, window
from dataflow.cli.support.execution import Outputs, execute
from dataflow.cli.support.output import (
    DIFFERENT,
    count,
    counting,
    facts_table,
    fail,
    out,
    plural,
    print_json,
    say,
    seconds,
    shown,
    size,
    table,
)

if TYPE_CHECKING:
    from dataflow.cli.support.arguments import BagOptions
    from dataflow.cli.support.run_options import ReportOptions
    from dataflow.graph import Graph
    from dataflow.interop.playing import Matching
    from dataflow.interop.streams import BagStreams
    from dataflow.supervision.core.report import RunReport, Watch


def replay_bag(
    path: Path,
    graph: Graph,
    bag: BagOptions,
    start: float | None,
    end: float | None,
    outputs: Outputs,
    options: dict[str, Any],
    told: ReportOptions,
    *,
    began: float,
) -> None:
    """Replays a bag through a graph; prints which topics are played, by which clock, and what was repaired."""
    from dataflow.editing.unmapped_topics import keep_untouched
    from dataflow.interop.playing import match
    from dataflow.interop.streams import BagStreams
    from dataflow.recording.layout import BAG
    from dataflow.recording.notices import notice
    from dataflow.supervision.replay import plan_replay
    from dataflow.supervision.run import replay

    matching = match(path, graph, bag.maps or ())
    with (
        counting("reading times", hidden=told.quiet) as watch,
        BagStreams(path, matching.played(), bag.clock, watch=watch, strict=bag.strict) as opened,
    ):
        if not told.quiet:
            say_what_is_played(matching, opened)
        whole = span(opened, plan_replay(opened, graph).streams)
        begin, finish = window(whole, start, end, path)
        shown = None if whole is None else (begin or whole[0], whole[1] if finish is None else min(whole[1], finish))
        metadata = {BAG: opened.facts()}

        def playing(watch: Watch | None) -> RunReport:
            report = replay(opened, graph=graph, start=start, end=end, watch=watch, metadata=metadata, **options)
            _say_what_was_not_read(opened, {name: held for name, (held, _) in report.streams.items()}, begin, finish)
            notice(path, opened.account.short)
            return report

        execute(playing, graph, outputs, shown, told, began=began)
        if outputs.record is not None:
            played = {p.topic for p in opened.played.values()}
            kept = keep_untouched(outputs.record, path, played, begin, finish, shift=opened.clock.shift)
            if kept and not told.quiet:
                names = ", ".join(sorted(kept))
                say(f"[dim]kept as they are: {plural(sum(kept.values()), 'message')} of {escape(names)}[/]")
        if opened.account.short:
            raise typer.Exit(DIFFERENT)


def _say_what_was_not_read(
    opened: BagStreams, delivered: Mapping[str, int], begin: int | None, end: int | None
) -> None:
    """Of topics that came with fewer messages than the bag holds of them in the span: how many, and why."""
    missing = {
        played.topic
        for stream, played in opened.played.items()
        if not played.static and delivered.get(stream, 0) < sum(1 for _ in opened.stamps(stream, begin, end))
    }
    opened.look_for_unread(missing, begin, end)
    opened.recount()
    for topic, unread in opened.account.unread.items():
        say(f"[yellow]{escape(f'{topic}: {unread}')}[/]")


def say_what_is_played(matching: Matching, opened: BagStreams) -> None:
    """A line for each stream, one for the clock, one for each repair, on standard error."""
    for line in opened.account.lines():
        say(f"[yellow]{escape(line)}[/]")
    names = {wanted.stream: wanted.name for wanted in matching.wanted}
    for stream, played in opened.played.items():
        info = opened.streams[stream]
        what = opened.static_notes.get(stream, "static" if played.static else plural(info.count, "message"))
        say(f"[dim]{escape(played.topic)} → {escape(names[stream])}: {played.type}, {what}[/]")
        if lost := opened.losses(played.topic):
            say(f"[yellow]{escape(played.topic)}: no place in {played.type} for {escape(', '.join(lost))}[/]")
    what = "header stamps" if opened.clock.kind == "header" else "log times"
    say(f"[dim]stamped with {what}: {escape(opened.clock.why)}[/]")


def describe_bag(path: Path, *, metadata: bool, json: bool) -> None:
    """Prints the topics of a bag: types, counts, rates, and what each can be played as; of MCAP files what they hold
    besides, with `metadata` all of it."""
    from dataflow.interop.bag import shortfalls
    from dataflow.interop.mcap_bag import McapBag
    from dataflow.interop.opening import open_bag
    from dataflow.interop.playing import readings_of
    from dataflow.interop.summary import summaries, total
    from dataflow.sync.stamps import format_stamp

    bag = open_bag(path)
    try:
        rows = summaries(bag, readings_of(bag))
        kind, notes = bag.kind, (*bag.notes, *shortfalls(bag))
        files = bag.files if isinstance(bag, McapBag) else []
        records = [(name, values) for file in files for name, values in file.metadata]
        attached = sum(file.attached for file in files)
    finally:
        bag.close()
    shown(notes)
    whole = total(rows)
    if metadata and not records:
        raise fail(f"--metadata: {path} ({kind}) holds no metadata records")
    if json:
        facts = {"path": str(path), "format": kind, "notes": list(notes), "bytes": _bytes(path)}
        facts |= {"attachments": attached, "metadata": [{"name": name, "values": values} for name, values in records]}
        print_json(facts | {"topics": [row.as_json() for row in rows]} | whole.as_json())
        return
    about = (
        ("file", str(path)),
        ("format", kind),
        ("size", size(_bytes(path))),
        *(("note", note) for note in notes),
        *((("from", format_stamp(whole.first)), ("to", format_stamp(whole.last))) if whole.messages else ()),
        ("duration", seconds(whole.duration * 1e-9)),
        ("messages", count(whole.messages)),
        *((("attachments", count(attached)),) if attached else ()),
        *((("metadata", f"{', '.join(name for name, _ in records)} (--metadata prints it)"),) if records else ()),
    )
    out.print(facts_table((name, value, "") for name, value in about))
    numbers = ("messages", "Hz")
    made = table("topic", "type", *numbers, "read as", "", right=numbers)
    for row in rows:
        rate = "" if row.rate is None else f"{row.rate:.2f}"
        notes_of = ", ".join(row.notes)
        made.add_row(*map(Text, (row.topic, row.type, count(row.count), rate, " or ".join(row.read_as), notes_of)))
    out.print(made)
    for name, values in records if metadata else ():
        told = table(name, "")
        for key, value in values.items():
            told.add_row(Text(key), Text(value))
        out.print(told)


def _bytes(path: Path) -> int:
    files = [path] if path.is_file() else [p for p in path.iterdir() if p.is_file()]
    return sum(p.stat().st_size for p in files)
