"""`dataflow info` and `diff`: what a recording holds, and where two differ."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table
from rich.text import Text

from dataflow.cli.support.arguments import AnyRecording, Json, Streams, existing_recording
from dataflow.cli.support.options import argument, option
from dataflow.cli.support.output import (
    DIFFERENT,
    count,
    facts_table,
    fail,
    out,
    plural,
    print_json,
    seconds,
    shown,
    size,
    table,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from dataflow.recording.streams.diff import DiffReport
    from dataflow.recording.streams.info import Description


def info(
    recording: AnyRecording,
    digests: Annotated[bool, option("--digests", "Read everything and print each stream's digest.")] = False,
    metadata: Annotated[bool, option("--metadata", "Print all metadata: parameters, versions, machine.")] = False,
    json: Json = False,
) -> None:
    """Describe a recording: streams, types, counts, rates, what made it.

    Any MCAP file will do, a torn one too, and ROS 1 and ROS 2 bags (.bag, .db3, .mcap, folders), for
    which it lists the types that each topic can be replayed as.

    Examples:

      dataflow info run.mcap
      dataflow info run.mcap --metadata
      dataflow info run.mcap --digests --json
      dataflow info drive.bag
    """
    from dataflow.cli.support.bags import describe_bag
    from dataflow.interop.opening import is_foreign
    from dataflow.recording import Recording
    from dataflow.recording.layout import RECORDING
    from dataflow.recording.mcap.index import NO_END
    from dataflow.recording.streams.info import describe

    if is_foreign(existing_recording(recording)):
        if digests:
            raise fail("--digests is of recordings; messages of a bag have none")
        describe_bag(recording, metadata=metadata, json=json)
        return
    with Recording(recording) as opened:
        described = describe(opened)
        shown([NO_END, *described.damage])
        computed = dict(opened.digests()) if digests else None
    if json:
        print_json(described.as_json() | ({} if computed is None else {"digests": computed}))
        return
    namespace = described.metadata.get(RECORDING, {}).get("namespace", "")
    out.print(facts_table(_facts(described)))
    out.print(_streams(described, namespace))
    if silent := _silent(described, namespace):
        out.print(Text(silent, style="dim"))
    if described.events:
        out.print(_mapping("events", described.events))
    for name, digest in (computed or {}).items():
        out.print(Text(f"{digest}  {_relative(name, namespace)}"), soft_wrap=True)
    if metadata:
        for record, values in described.metadata.items():
            out.print(_mapping(record, values))


def _facts(described: Description) -> Iterator[tuple[str, str, str]]:
    """Yields name, value and style of each fact about a whole recording."""
    from dataflow.recording.layout import GRAPH, OUTCOME, RECORDING, RECOVERED, RUN
    from dataflow.recording.mcap.attachments import tells_of_run
    from dataflow.recording.streams.cutting import cut_of, triggers_of
    from dataflow.recording.streams.facts import group_of
    from dataflow.sync.stamps import format_stamp

    made = described.metadata
    uncompressed = sum(s.bytes for s in described.streams)
    yield "file", described.path, ""
    yield "size", f"{size(described.bytes)}, {size(uncompressed)} uncompressed", ""
    yield "written by", described.library + (f", profile {described.profile}" if described.profile else ""), ""
    if GRAPH in made:
        yield "graph", f"{made[GRAPH].get('name', '')}, namespace {made.get(RECORDING, {}).get('namespace', '')}", ""
    if RUN in made:
        yield "made by", _made_by(made[RUN]), ""
    for record, machine in sorted(made.items()):
        group, of = group_of(record)
        if group == "machine":
            what = f"{machine.get('cpu', '')}, {machine.get('cores', '?')} cores, {machine.get('os', '')}"
            yield f"machine {of}".rstrip(), what, ""
    if OUTCOME in made:
        outcome = made[OUTCOME].get("outcome", "")
        yield "outcome", outcome, "" if outcome == "complete" else "yellow"
    if (part := cut_of(made)) is not None:
        ends = [f"{word} {format_stamp(s)}" for word, s in (("from", part.start), ("to", part.end)) if s is not None]
        yield "part of", " ".join([part.of, *ends]), ""
    for why in triggers_of(made):
        yield "kept because", why, ""
    if RECOVERED in made:
        yield "recovered", f"from {made[RECOVERED].get('of', '')}: what could be read of it", "yellow"
    if described.torn:
        lost = f"; {plural(described.lost_bytes, 'byte')} of an unfinished record are left out"
        torn = "no proper end: it is being written, or its writer died"
        yield "torn", torn + (lost if described.lost_bytes else ""), "yellow"
    for note in described.damage:
        yield "damaged", note, "yellow"
    if described.start is not None and described.end is not None:
        yield "from", format_stamp(described.start), ""
        yield "to", format_stamp(described.end), ""
        yield "duration", seconds(described.duration * 1e-9), ""
    yield "messages", count(described.messages), ""
    if described.firings:
        yield "firings of", ", ".join(described.firings), ""
    for each in described.attachments:
        yield "attachment", ", ".join(part for part in (each.name, each.media_type, size(each.bytes)) if part), ""
    if told := [name for name in made if not tells_of_run(name)]:
        yield "metadata", f"{', '.join(told)} (--metadata prints it)", ""


def _made_by(run: Mapping[str, str]) -> str:
    from dataflow.sync.stamps import format_stamp

    started = run.get("started", "")
    when = format_stamp(int(started)).partition(".")[0].replace("T", " ") if started.isdigit() else ""
    return f"{run.get('mode', '')}, {when} UTC" if when else run.get("mode", "")


def _streams(described: Description, namespace: str) -> Table:
    foreign = any(not s.readable for s in described.streams)
    numbers = ("messages", "Hz", "size")
    made = table("stream", "type", *numbers, "", right=numbers)
    for s in described.streams:
        if not s.count:
            continue
        notes = ["static"] if s.static else []
        notes += [f"{s.incarnations} incarnations"] if s.incarnations > 1 else []
        notes += [f"unsupported encoding ({s.encoding})"] if not s.readable else []
        notes += ["declared differently now"] if s.declared_otherwise else []
        notes += ["type read from the recording"] if s.generic else []
        kind = s.type if s.readable else f"{s.schema} ({s.encoding})" if foreign else s.schema
        rate = "" if s.rate is None or s.static else f"{s.rate:.2f}"
        row = (_relative(s.name, namespace), kind, count(s.count), rate, size(s.bytes), ", ".join(notes))
        made.add_row(*map(Text, row))
    return made


def _silent(described: Description, namespace: str) -> str:
    """Names the streams without a message, as those of a sensor that is off are."""
    names = [_relative(s.name, namespace) for s in described.streams if not s.count]
    return f"without messages: {', '.join(names)}" if names else ""


def _relative(stream: str, namespace: str) -> str:
    return stream.removeprefix(f"{namespace}/") if namespace else stream


def _mapping(title: str, values: Mapping[str, Any]) -> Table:
    lines = {key: str(value).splitlines() or [""] for key, value in values.items()}
    short = {key: of[0] if len(of) == 1 else f"{plural(len(of), 'line')}: {of[0]}" for key, of in lines.items()}
    return facts_table(((key, value, "") for key, value in short.items()), title)


def diff(
    a: Annotated[Path, argument("A", "A recording.")],
    b: Annotated[Path, argument("B", "Another one.")],
    streams: Streams = None,
    tolerance: Annotated[
        float | None, option("--tolerance X", "Decimal numbers may differ by so much. Default: bit for bit.")
    ] = None,
    json: Json = False,
) -> None:
    """Compare two recordings, stream by stream.

    Exit code 0: the same; 1: different, or messages of another program's file cannot be read; 2: could not compare.

    Examples:

      dataflow diff run.mcap again.mcap
      dataflow diff a.mcap b.mcap --stream odometry/odometry --tolerance 1e-6
      dataflow diff a.mcap b.mcap --json
    """
    from dataflow.cli.support.arguments import chosen_streams
    from dataflow.recording import Recording
    from dataflow.recording.layout import RECORDING
    from dataflow.recording.streams.diff import diff as compare

    with (
        Recording(existing_recording(a)) as first,
        Recording(existing_recording(b)) as second,
    ):
        if tolerance is not None and not 0 <= tolerance < float("inf"):
            raise fail(f"--tolerance {tolerance:g}: expected a number, 0 or more")
        spaces = {opened.metadata.get(RECORDING, {}).get("namespace", "") for opened in (first, second)}
        namespace = spaces.pop() if len(spaces) == 1 else ""
        known = sorted({*first.streams, *second.streams})
        names = chosen_streams(streams, known, namespace) if streams else None
        report = compare(first, second, streams=names, tolerance=tolerance)
    if json:
        print_json(report.as_json())
    else:
        _print_differences(report, namespace)
    if not report.same:
        raise typer.Exit(DIFFERENT)


def _print_differences(report: DiffReport, namespace: str) -> None:
    from dataflow.sync.stamps import format_stamp

    numbers = ("A", "B", "differ", "max |A-B|")
    made = table("stream", "result", *numbers, right=numbers)
    for s in report.streams:
        partnerless = abs(s.count_a - s.count_b) if s.outcome.startswith("only") else s.missing_in_a + s.missing_in_b
        differing = s.differing + partnerless
        made.add_row(
            Text(_relative(s.stream, namespace)),
            Text(s.outcome, style="green" if s.outcome in ("same", "within tolerance") else "red"),
            count(s.count_a),
            count(s.count_b),
            count(differing) if differing else "",
            f"{s.max_difference:.3g}" if s.max_difference else "",
        )
    out.print(made)
    firsts = [s for s in report.streams if s.first is not None]
    if firsts:
        out.print(Text("first differences", style="bold"))
    for s in firsts:
        assert s.first is not None
        where = f"  {_relative(s.stream, namespace)} at {format_stamp(s.first.stamp)}, {s.first.field}: "
        out.print(Text(where + s.first.detail), soft_wrap=True)
    same = sum(s.outcome in ("same", "within tolerance") for s in report.streams)
    if report.same:
        how = "bit for bit" if report.tolerance is None else f"within {report.tolerance:g}"
        out.print(f"[green]the same[/]: {plural(same, 'stream')}, {how}")
    else:
        out.print(f"[red]different[/]: {len(report.streams) - same} of {plural(len(report.streams), 'stream')}")
