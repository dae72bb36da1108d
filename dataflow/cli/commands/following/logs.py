"""`dataflow logs`: what operators have logged and printed, of a running graph or a recording."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.text import Text

from dataflow.cli.commands.completion import running_operators
from dataflow.cli.commands.following.live import THE_ONLY, Running
from dataflow.cli.support.arguments import existing_recording
from dataflow.cli.support.options import argument, option
from dataflow.cli.support.output import INTERRUPTED, fail, out, print_json_line, say

if TYPE_CHECKING:
    from dataflow.recording import LogLine

LEVELS = ("debug", "info", "warning", "error", "fatal")
LOOK_EVERY = 0.1
_STYLES = {"debug": "dim", "info": "", "warning": "yellow", "error": "red", "fatal": "bold red"}

_Operators = Annotated[
    list[str] | None,
    option("--operator NAME", "Only this operator or process. May be repeated.", autocompletion=running_operators),
]


def logs(
    recording: Annotated[
        Path | None, argument("[RECORDING|RUN]", "A recording (.mcap), or the name of a running graph.")
    ] = None,
    operators: _Operators = None,
    level: Annotated[str, option("--level LEVEL", "Only this level and worse: " + ", ".join(LEVELS) + ".")] = "debug",
    follow: Annotated[bool, option("--follow -f", "Go on with what comes, until the graph ends.")] = False,
    last: Annotated[int | None, option("--last -n N", "Only the last N lines.")] = None,
    which: Running = THE_ONLY,
    json: Annotated[bool, option("--json", "One JSON object a line.")] = False,
) -> None:
    """Show what operators have logged and printed: of the running graph, or of a recording.

    Each line has its wall time, the event time of the operator's call, its level and its operator. `self.log` of an
    operator, Python's logging and warnings, `print` and what libraries write are all there; the least level that
    loggers hand on is `dataflow run --log-level`. Events of a recorded run (restarts, faults) are among its lines.

    Examples:

      dataflow logs
      dataflow logs --follow --operator detector --level warning
      dataflow logs run.mcap --level error
      dataflow logs run.mcap --json | jq .text
    """
    if level not in LEVELS:
        raise fail(f"--level {level}: expected one of {', '.join(LEVELS)}")
    if last is not None and last < 1:
        raise fail(f"--last {last}: expected 1 or more")
    if last is not None and follow:
        raise fail("--last shows what is there, --follow what comes: leave one out")
    if recording is not None and not recording.exists() and recording.suffix != ".mcap":
        if which.graph is not None:
            raise fail(f"{recording} and --graph {which.graph} both name a running graph; leave one out")
        which, recording = replace(which, graph=str(recording)), None
    if recording is not None and (follow or which != THE_ONLY):
        raise fail("--follow, --graph and --wait are about a running graph; leave them out for a recording")
    lines = _running(which, follow=follow) if recording is None else _recorded(existing_recording(recording))
    wanted = (line for line in lines if _is_wanted(line, operators, LEVELS.index(level)))
    shown = 0
    try:
        for line in _last(wanted, last):
            shown += 1
            _print(line, json=json)
    except KeyboardInterrupt:
        raise typer.Exit(INTERRUPTED) from None
    if not shown and not json:
        _report_nothing(recording, operators, level)


def _report_nothing(recording: Path | None, operators: list[str] | None, level: str) -> None:
    some = " that was asked for" if operators or level != "debug" else ""
    say(f"[dim]nothing was logged or printed{some}[/]")
    if recording is not None and operators:
        _report_unknown(recording, operators)


def _recorded(path: Path) -> Iterator[LogLine]:
    """The lines of a recording and its events, in the order of their event time."""
    from dataflow.recording import LogLine, Recording

    with Recording(path) as opened:
        found = list(opened.logs())
        for event in opened.events():
            data = {key: value for key, value in event.data.items() if key != "text"}
            text = str(event.data.get("text") or f"{event.name} {data or ''}".rstrip())
            found.append((event.stamp, LogLine("warning", text, "supervisor", source=event.name, stamp=event.stamp)))
    for _, line in sorted(found, key=lambda entry: entry[0]):
        yield line


def _report_unknown(path: Path, names: list[str]) -> None:
    """Prints which of the names are those of no operator or process of a recording, and what is near."""
    from dataflow.graph.problems import did_you_mean
    from dataflow.recording import Recording

    with Recording(path) as opened:
        known = {
            *opened.firing_batches(),
            *(name for _, line in opened.logs() for name in (line.operator, line.process)),
        }
    for name in names:
        if name not in known:
            hint = did_you_mean(name, sorted(known - {""}), "there are")
            say(f"[yellow]no operator or process {escape(repr(name))} is in the recording:[/] {escape(hint)}")


def _running(which: Running, *, follow: bool) -> Iterator[LogLine]:
    """The lines of a running graph; with `follow` until it has ended."""
    from dataflow.client.attach import still_runs
    from dataflow.recording import LogLine
    from dataflow.transport.log_file import LogFollower

    found = which.followed() if follow else which.found()
    follower = LogFollower(found.pid)
    try:
        while True:
            goes_on = follow and still_runs(found)
            for value in follower.lines():
                yield LogLine.from_json(value)
            if not goes_on:
                return
            time.sleep(LOOK_EVERY)
    finally:
        follower.close()


def _is_wanted(line: LogLine, operators: list[str] | None, severity: int) -> bool:
    return line.severity >= severity and (not operators or line.operator in operators or line.process in operators)


def _last(lines: Iterable[LogLine], number: int | None) -> Iterable[LogLine]:
    """All lines, or the last of those that are there already."""
    if number is None:
        return lines
    from collections import deque

    return deque(lines, maxlen=number)


def _print(line: LogLine, *, json: bool) -> None:
    if json:
        print_json_line(line.to_json())
        return
    from dataflow.sync.stamps import format_stamp

    clock = time.strftime("%H:%M:%S", time.localtime(line.time * 1e-9)) if line.time else ""
    wall = f"{clock}.{line.time // 1_000_000 % 1000:03d}" if clock else ""
    head = Text.assemble(
        (f"{wall:<12}  ", "dim"),
        (f"{'' if line.stamp is None else format_stamp(line.stamp):<14}  ", "dim"),
        (f"{line.level:<7}  ", _STYLES[line.level]),
        (line.name, "bold"),
    )
    for part in line.text.split("\n"):
        out.print(Text.assemble(head, "  ", (part, _STYLES[line.level])), soft_wrap=True)
