"""Output of the commands: results on standard output, progress and errors on standard error, one meaning per exit
code."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.console import Console, ConsoleOptions, RenderableType
from rich.markup import escape
from rich.segment import Segment
from rich.text import Text

from dataflow.text import json_text, visible, visible_lines

if TYPE_CHECKING:
    from rich.table import Table

DIFFERENT = 1
"""Exit code: it ran, and the answer is no (streams differ, the graph has faults, a run failed)."""
COULD_NOT_RUN = 2
"""Exit code: it could not run (a file is missing, an option is wrong)."""
INTERRUPTED = 130
"""Exit code: ended by Ctrl-C."""

TRACEBACK = "DATAFLOW_TRACEBACK"
"""Environment variable: any value but 0 and none shows the tracebacks of errors."""

PIPE_WIDTH = 120
"""Columns of tables that go into a file or a pipe, unless COLUMNS is set."""

LONGEST = 10_000
"""Characters of one wrapped text, such as a cell of a table; of a longer one the rest is counted. A name in a
foreign recording may have millions, and breaking those into lines takes minutes."""


class _VisibleConsole(Console):
    """Passes everything that is printed through `visible_lines`; the console's styles and cursor movements stay."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        if isinstance(renderable, Text) and len(renderable) > LONGEST and not (options or self.options).no_wrap:
            renderable = renderable[:LONGEST] + f"… ({len(renderable) - LONGEST:,} more characters)"
        for segment in super().render(renderable, options):
            yield segment if segment.control else segment._replace(text=visible_lines(segment.text))


def _console(*, stderr: bool) -> Console:
    stream = sys.stderr if stderr else sys.stdout
    piped = not stream.isatty() and "COLUMNS" not in os.environ
    return _VisibleConsole(stderr=stderr, highlight=False, width=PIPE_WIDTH if piped else None)


out = _console(stderr=False)
err = _console(stderr=True)


_notes: dict[str, Path] = {}
"""Notes of the files that the command has opened, and the file of each."""
_said: list[str] = []


def shown(notes: Iterable[str]) -> None:
    """Notes of files that a command has printed in its own way."""
    _said.extend(notes)


def forget_notes() -> None:
    """Begins a command: what another one in this process has opened and said is not its own."""
    _notes.clear()
    _said.clear()


def print_json(value: Any) -> None:
    """Prints one JSON document on standard output; an object also holds the notes of the files that were opened."""
    if isinstance(value, dict) and _notes:
        own = list(value.get("notes", ()))
        value = value | {"notes": [*own, *(note for note in _notes if not any(note in text for text in own))]}
    print(json_text(value, indent=2))


def print_json_line(value: Any) -> None:
    """Prints one JSON value as one line, and flushes."""
    print(json_text(value), flush=True)


def say(text: str) -> None:
    """A line about what happens, on standard error. `text` is markup."""
    _said.append(text)
    err.print(text, soft_wrap=not err.is_terminal)


def fail(message: str, *, details: str = "", code: int = COULD_NOT_RUN) -> typer.Exit:
    """Prints an error; the caller raises what it returns."""
    say(escape(message) if code == INTERRUPTED else f"[bold red]error:[/] {escape(message)}")
    if details.strip():
        err.print(f"[dim]{escape(details.rstrip())}[/]", soft_wrap=True)
    return typer.Exit(code)


def wants_traceback() -> bool:
    """Returns whether `dataflow --traceback` or the environment asks for our own tracebacks."""
    return os.environ.get(TRACEBACK, "0") not in ("", "0")


def own_traceback(text: str) -> str:
    """A traceback of the runtime's own code where it is asked for; else how to ask for it."""
    return text if wants_traceback() else f"where in the code: run it again with {TRACEBACK}=1"


@contextmanager
def friendly_errors() -> Iterator[None]:
    """Turns the errors that bad input causes into one clear message and an exit code; others pass.

    What the opening of files brings to light is printed at the end, as far as the command has not said it.
    """
    from dataflow.recording.notices import listening

    try:
        with listening(_take):
            yield
        _say_notes()
    except typer.Exit:
        _say_notes()
        raise
    except Exception as error:
        if interrupted_by_user(error):
            raise KeyboardInterrupt from None
        explained = _explained(error)
        if explained is None:
            raise
        if wants_traceback():
            err.print(escape(traceback.format_exc().rstrip()), style="dim", soft_wrap=True)
        message, details, code = explained
        if message.startswith("\n"):  # faults of a graph: places, lines and carets
            err.print(escape(message[1:]), soft_wrap=True)
            raise typer.Exit(code) from None
        raise fail(message, details=details, code=code) from None


def _take(file: Path, note: str) -> None:
    _notes.setdefault(note, file)


def _say_notes() -> None:
    for note, file in sorted(_notes.items(), key=lambda item: -len(item[0])):
        if not any(note in text or escape(note) in text for text in _said):
            where = "" if note.startswith(file.name) else f"{file.name}: "
            say(f"[yellow]{escape(where + note)}[/]")


def interrupted_by_user(error: BaseException | None) -> bool:
    """Returns whether an error is what Python or a library has made of Ctrl-C."""
    return error is not None and (
        isinstance(error, KeyboardInterrupt) or interrupted_by_user(error.__cause__ or error.__context__)
    )


_KNOWN = {
    *("BaselineError", "BusError", "ChaosError", "ContractError", "EnvError", "FoxgloveError", "KeysError"),
    *("MappingError", "MessageError", "InvalidName", "NetworkError", "NotRunning", "OperatorImportError"),
    *("ParameterError", "RecordingError", "RegistryError", "ReplayError", "SweepError", "ViewerError", "WrongCommand"),
}
"""Errors of this package whose messages name the remedy."""


def _explained(error: Exception) -> tuple[str, str, int] | None:
    """(message, details, exit code) of an error that users can do something about; None for a bug."""
    from dataflow.client.attach import MachineUnreachable
    from dataflow.client.processes import NoAnswer, RequestRejected
    from dataflow.execution.failure import OperatorFailure
    from dataflow.graph import GraphError
    from dataflow.supervision.core.report import RunFailed

    match error:
        case GraphError():
            return f"\n{error}", "", COULD_NOT_RUN
        case RunFailed():
            details = own_traceback(error.details) if error.internal else error.details
            if about_a_file(error.details) and not wants_traceback():
                details = ""  # the message names the file; where in the operator it was opened does not help
            message = "\n".join((str(error), *getattr(error, "__notes__", ())))
            return message, details, INTERRUPTED if error.interrupted else DIFFERENT
        case MachineUnreachable() | NoAnswer() | RequestRejected():
            return str(error), "", DIFFERENT
        case OperatorFailure():  # of calls that are made again
            return str(error), error.traceback, COULD_NOT_RUN
        case BrokenPipeError():
            return None
        case OSError() if error.strerror and error.filename:
            return f"{error.filename}: {error.strerror}", "", COULD_NOT_RUN
    ours = {kind.__name__ for kind in type(error).__mro__ if kind.__module__.startswith("dataflow.")}
    return (str(error), "", COULD_NOT_RUN) if ours & _KNOWN else None


_FILE_ERRORS = ("FileNotFoundError", "NotADirectoryError", "IsADirectoryError", "PermissionError", "SourceError")


def about_a_file(details: str) -> bool:
    """Returns whether a traceback ends with a file that is missing or unreadable; its text may have several lines."""
    lines = details.rpartition('\n  File "')[2].splitlines()
    raised = next((line for line in lines[1:] if not line.startswith(" ")), "")
    return details.startswith("Traceback") and raised.partition(":")[0].rpartition(".")[2] in _FILE_ERRORS


@contextmanager
def counting(what: str, *, hidden: bool) -> Iterator[Callable[[int], None] | None]:
    """Shows on a terminal how many messages `what` has seen, unless it is `hidden`."""
    if hidden or not err.is_terminal:
        yield None
        return
    with err.status(what) as status:
        yield lambda seen: status.update(f"{what} · {count(seen)} messages")


def table(*columns: str, right: tuple[str, ...] = (), title: str | None = None) -> Table:
    """A table in the house style; the columns in `right` hold numbers. Text wraps, numbers never do."""
    from rich import box
    from rich.table import Table

    class Rows(Table):
        """Shows a line break in a cell as its escape: a name in a foreign file cannot pass for another row."""

        def add_row(self, *cells: RenderableType | None, **more: Any) -> None:
            super().add_row(*(_one_line(cell) for cell in cells), **more)

    made = Rows(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False)
    for column in columns:
        number = column in right
        made.add_column(column, justify="right" if number else "left", no_wrap=number, overflow="fold")
    return made


def facts_table(rows: Iterable[tuple[str, str, str]], title: str | None = None) -> Table:
    """Names and values, each with its style, in two columns; names are whole where there is no title."""
    from rich.table import Table

    grid = Table.grid(padding=(0, 2))
    grid.title, grid.title_justify, grid.title_style = title, "left", "bold"
    grid.add_column(style="dim", no_wrap=title is None, overflow="fold")
    grid.add_column(overflow="fold")
    for name, value, style in rows:
        grid.add_row(Text(name), Text(visible(value), style=style))
    return grid


def _one_line(cell: RenderableType | None) -> RenderableType | None:
    if isinstance(cell, str):
        return visible(cell)
    return Text(visible(cell.plain), style=cell.style) if isinstance(cell, Text) and "\n" in cell.plain else cell


def count(number: float) -> str:
    """1234567 → "1,234,567"."""
    return f"{number:,.0f}"


_PARTS = {"@log": "recording", "@recorder": "recorder", "@view": "viewer's file"}


def called(name: str) -> str:
    """Returns the name of an operator or a process for people; parts of the runtime are named by what they do."""
    return _PARTS.get(name, name)


def plural(number: int, word: str) -> str:
    """(1, "stream") → "1 stream"; (2, "stream") → "2 streams"."""
    return f"{number:,} {word}{'' if number == 1 else 's'}"


def size(nbytes: float) -> str:
    """Bytes for people: "3.2 MB"."""
    for unit in ("B", "kB", "MB"):
        if abs(nbytes) < 999.95:
            return f"{nbytes:.0f} {unit}" if unit == "B" else f"{nbytes:.1f} {unit}"
        nbytes /= 1000
    return f"{nbytes:.1f} GB"


def seconds(duration: float) -> str:
    """A duration in seconds for people: "0.63 s", "12.3 s", "4 min 05 s", "2 h 03 min"."""
    if duration < 59.95:
        return f"{duration:.2f} s" if duration < 9.995 else f"{duration:.1f} s"
    minutes, rest = divmod(round(duration), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"


def milliseconds(nanoseconds: float) -> str:
    """1234567 → "1.23 ms"."""
    return f"{nanoseconds * 1e-6:,.2f} ms"
