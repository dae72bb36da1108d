"""Holds what the commands that edit recordings share: files, spans, progress, and what is printed in the end."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.text import Text

from dataflow.cli.support.arguments import existing
from dataflow.cli.support.options import argument, option
from dataflow.cli.support.output import DIFFERENT, count, err, fail, out, plural, print_json, say, seconds, size, table
from dataflow.cli.support.quantities import parsed_duration, parsed_moment

if TYPE_CHECKING:
    from dataflow.editing.report import WrittenFile
    from dataflow.recording.streams.copying import Origin

EditedFile = Annotated[Path, argument("RECORDING", "A recording, or any other MCAP file.")]
Out = Annotated[Path, option("--out -o OUT.mcap", "The file to write.")]
Compression = Annotated[
    Literal["zstd", "lz4", "none"],
    option(
        "--compression zstd|lz4|none", "How the file is compressed: zstd gives the smallest, lz4 takes less CPU time."
    ),
]
Quiet = Annotated[bool, option("--quiet -q", "Show no progress.")]
Word = str | None


@contextmanager
def opened_file(path: Path) -> Iterator[Origin]:
    """An MCAP file, another program's as far as it can be read; other bags are answered with what makes one of them."""
    from dataflow.interop.opening import is_foreign
    from dataflow.recording.mcap.ending import MAGIC
    from dataflow.recording.streams.copying import Origin
    from dataflow.recording.streams.part_folder import parts_in

    if path.is_dir():
        made = f"dataflow merge {path}/*.mcap -o {path.name}.mcap" if parts_in(path) else converting(path)
        raise fail(f"{path} is a folder: name its .mcap file, or make one file of it: {made}")
    existing(path, "a recording")
    with path.open("rb") as file:
        head = file.read(len(MAGIC))
    if head != MAGIC and path.suffix in (".bag", ".db3"):
        raise fail(f"{path} is no MCAP file; make one of it: {converting(path)}")
    with Origin(path, lenient=head == MAGIC and is_foreign(path)) as origin:
        yield origin


def converting(path: Path) -> str:
    return f"dataflow convert {path} {path.with_suffix('').name}.mcap --to mcap"


def asked_span(origin: Origin, start: Word, end: Word, duration: Word) -> tuple[int | None, int | None]:
    """The stamps of a cut; None where nothing is cut off."""
    from dataflow.recording.streams.cutting import cut_of

    if end is not None and duration is not None:
        raise fail("--to and --duration both say where to end: name one of them")
    whole = origin.span()
    if whole is None:
        raise fail(f"{origin.path} holds no messages: there is nothing to cut")
    part = cut_of(origin.metadata)
    first, last = whole
    if part is not None:
        first, last = part.start or first, part.end or last
    begin = None if start is None else parsed_moment("--from", start, first)
    finish = None if end is None else parsed_moment("--to", end, first)
    if duration is not None:
        finish = (first if begin is None else begin) + parsed_duration("--duration", duration)
    length = seconds((last - first) * 1e-9)
    if begin is not None and begin > last:
        raise fail(f"--from {start}: {origin.path} ends {length} after its first message")
    if finish is not None and finish < (first if begin is None else begin):
        raise fail(f"--to {end}: that is before the beginning of the part")
    if begin is None and finish is None:
        raise fail("nothing to cut: say where to begin (--from) or to end (--to, --duration)")
    return (
        None if begin is None or begin <= whole[0] else begin,
        None if finish is None or finish >= whole[1] else finish,
    )


def refuse_itself(output: Path, inputs: Sequence[Path]) -> None:
    if any(output.exists() and output.samefile(path) for path in inputs):
        raise fail(f"--out {output} is what is being read; name another file")


@contextmanager
def copying(what: str, hidden: bool) -> Iterator[Callable[[int, int], None]]:
    """Shows how many messages of how many are written."""
    if hidden or not err.is_terminal:
        yield lambda done, total: None
        return
    columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=err, transient=True) as progress:
        task = progress.add_task(what, total=None)
        yield lambda done, total: progress.update(task, completed=done, total=total)


def tell_edited(done: WrittenFile, *, json: bool) -> None:
    """Prints what was written; the exit code is 1 where something of it is lost."""
    if json:
        print_json(done.as_json())
    else:
        _print_edited(done)
    fail_if_lost([done])


def fail_if_lost(done: Iterable[WrittenFile]) -> None:
    """The exit code is 1 where a file that was written lacks messages, or may lack some."""
    if any(one.lost or one.lacking for one in done):
        raise typer.Exit(DIFFERENT)


def _print_edited(done: WrittenFile) -> None:
    made = table("stream", "messages", right=("messages",))
    for name, number in done.streams.items():
        made.add_row(Text(name), count(number))
    out.print(made)
    if done.beyond:
        say(f"{plural(done.beyond, 'message')} from beyond the span go along, which its firings took or made")
    for note in done.notes:
        say(f"[yellow]{escape(note)}[/]")
    print_unknown(done.unknown)
    low, high = done.span or (0, 0)
    what = f"{plural(done.messages, 'message')} in {seconds((high - low) * 1e-9)}, {size(done.bytes)}"
    what += f", {plural(done.attachments, 'attachment')}" if done.attachments else ""
    out.print(f"wrote {escape(done.path)} ({what})", soft_wrap=True)


def print_unknown(operators: Collection[str]) -> None:
    if operators:
        say(
            f"[yellow]no recorded state at or before the cut:[/] {escape(', '.join(sorted(operators)))}: they begin "
            "afresh, and are not verified before their next recorded state (`record: {snapshots: 10s}` records an "
            "operator's `state`; an operator without a state sets `stateless = True`)"
        )
