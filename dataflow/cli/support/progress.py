"""The live table of a running graph and the bar above it."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table
from rich.text import Text

from dataflow.cli.support.output import called, count, seconds
from dataflow.cli.support.quantities import speed_text
from dataflow.supervision.core.report import OperatorCounts, Status, Watch
from dataflow.sync import FOREVER, NEVER

NAMED = 3
"""Processes that are waited for and named at most."""
ENDING = ("closing", "over")
"""Phases in which the report follows."""
RATE_OVER = 0.8
"""Seconds over which rates are taken."""


class Rates:
    """Firings per second over the last second or so."""

    def __init__(self) -> None:
        self._seen: dict[str, tuple[float, int, float | None]] = {}

    def of(self, name: str, firings: int, now: float) -> float | None:
        """The rate of a counter that has reached `firings`; None until there is one."""
        at, before, rate = self._seen.setdefault(name, (now, firings, None))
        if now - at >= RATE_OVER:
            rate = (firings - before) / (now - at)
            self._seen[name] = (now, firings, rate)
        return rate


class RunDisplay:
    """Renders a `Status`: a bar over event time (or the sources' steps) and a row for each operator."""

    def __init__(self, console: Console, *, sources: Sequence[str] = (), span: tuple[int, int] | None = None) -> None:
        self.span = span
        self.sources = frozenset(sources)
        self.status: Status | None = None
        self.began: float | None = None
        self._rates = Rates()
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            TextColumn("{task.fields[note]}"),
            console=console,
        )
        self._task = self._bar.add_task("starting", total=None, note="")

    def update(self, status: Status) -> None:
        """Takes a new status; may be called from any thread."""
        self.status = status
        if self.began is None and status.phase != "starting":
            self.began = time.monotonic()
        total, completed = self.fraction(status)
        parts = (waiting_for(status), self.reached(status), self._clock(total, completed))
        note = " · ".join(part for part in parts if part)
        phase = "paused" if status.paused and status.phase not in ENDING else status.phase
        note += f" · {speed_text(status.speed)}" if status.speed is not None else ""
        self._bar.update(self._task, description=phase, total=total, completed=completed, note=note)

    def fraction(self, status: Status) -> tuple[float | None, float]:
        """(total, completed): seconds of event time where the span is known, else steps of the sources."""
        if self.span is not None:
            first, last = self.span
            reached = min(max(status.covered, first), last)
            return max(last - first, 1) * 1e-9, (reached - first) * 1e-9
        if status.steps is not None:
            done = max((c.firings for name, c in status.operators.items() if name in self.sources), default=0)
            return float(status.steps), float(min(done, status.steps))
        return None, 0.0

    def reached(self, status: Status) -> str:
        """Returns how far it has come, in words."""
        total, completed = self.fraction(status)
        if self.span is not None and total is not None:
            return f"{completed:.1f} of {total:.1f} s"
        if total is not None:
            return f"{completed:,.0f} of {total:,.0f} steps"
        return f"{count(fired)} firings" if (fired := sum(c.firings for c in status.operators.values())) else ""

    def _clock(self, total: float | None, completed: float) -> str:
        """Time spent, and an estimate of what is left."""
        if self.began is None:
            return ""
        spent = time.monotonic() - self.began
        left = self.left(total, completed)
        return f"{seconds(spent)}, {left}" if left else seconds(spent)

    def left(self, total: float | None, completed: float) -> str:
        """An estimate of what is left, in words; nothing while there is none."""
        spent = 0.0 if self.began is None else time.monotonic() - self.began
        if total is None or completed <= 0 or completed >= total or spent < 1.0:
            return ""
        return f"{seconds(spent * (total - completed) / completed)} left"

    def __rich__(self) -> RenderableType:
        if self.status is None or not self.status.operators:
            return self._bar
        return Group(self._bar, self._table(self.status))

    def _table(self, status: Status) -> Table:
        now = time.monotonic()
        table = Table(box=None, pad_edge=False, header_style="dim", padding=(0, 2, 0, 0))
        table.add_column("operator", overflow="fold")
        table.add_column("process", style="dim", overflow="fold")
        for name in ("firings", "Hz", "out", "dropped", "CPU", "wall", "lag"):
            table.add_column(name, justify="right", no_wrap=True)
        front = max((c.done for c in status.operators.values() if c.done not in (NEVER, FOREVER)), default=None)
        elapsed = now - self.began if self.began is not None else 0.0
        for name, counts in status.operators.items():
            rate = self._rates.of(name, counts.firings or counts.emitted, now)
            table.add_row(
                Text(called(name)),
                Text(called(status.process_of.get(name, ""))),
                count(counts.firings) if counts.firings else "",
                "" if rate is None else f"{rate:.1f}",
                count(counts.emitted) if counts.emitted else "",
                Text(count(counts.dropped), style="yellow") if counts.dropped else "",
                _share(counts.cpu_ns, elapsed),
                _share(counts.wall_ns, elapsed),
                _lag(counts, front),
            )
        return table


def waiting_for(status: Status) -> str:
    """The processes that a start is waiting for, in words."""
    if not status.waiting:
        return ""
    more = len(status.waiting) - NAMED
    return f"waiting for {', '.join(map(called, status.waiting[:NAMED]))}" + (f" and {more} more" if more > 0 else "")


def _share(nanoseconds: int, elapsed: float) -> str:
    return f"{nanoseconds * 1e-9 / elapsed:.0%}" if elapsed > 0.2 else ""


def _lag(counts: OperatorCounts, front: int | None) -> str:
    """Returns how far an operator is behind the foremost one, in event time."""
    if counts.done == FOREVER:
        return "done"
    if counts.done == NEVER or front is None:
        return ""
    return seconds((front - counts.done) * 1e-9)


@contextmanager
def shown(console: Console, display: RunDisplay, *, quiet: bool) -> Iterator[Watch]:
    """Shows `display` while the block runs; a terminal gets a live table, a log a line every few seconds.

    Notes are printed as they come, also where there is no display.
    """
    notes = Notes(console)
    if quiet:
        yield notes.update
    elif not console.is_terminal:
        yield _both(notes.update, _line_printer(console, display))
    else:
        with Live(display, console=console, refresh_per_second=5, transient=True, redirect_stdout=False):
            yield _both(notes.update, display.update)


class Notes:
    """Prints the notes of a run while it goes on, each once; those that it ends with are in its report."""

    def __init__(self, console: Console) -> None:
        self._console, self._printed = console, 0

    def update(self, status: Status) -> None:
        """Prints what is new. May be called from any thread."""
        if status.phase in ENDING:
            return
        for note in status.notes[self._printed :]:
            self._printed += 1
            self._console.print(Text(f"note: {note}", style="yellow"), soft_wrap=True)


def _both(first: Watch, second: Watch) -> Watch:
    def watch(status: Status) -> None:
        first(status)
        second(status)

    return watch


def _line_printer(console: Console, display: RunDisplay, every: float = 5.0) -> Watch:
    due, phase = 0.0, ""

    def watch(status: Status) -> None:
        nonlocal due, phase
        display.update(status)
        now = time.monotonic()
        if now >= due or status.phase != phase:
            due, phase = now + every, status.phase
            spent = seconds(time.time() - status.started) if status.started else ""
            left = display.left(*display.fraction(status)) if status.phase not in ENDING else ""
            note = waiting_for(status) or ", ".join(part for part in (display.reached(status), left) if part)
            console.print(Text(f"{status.phase:<8}  {spent:>8}  {note}".rstrip()), soft_wrap=True)

    return watch
