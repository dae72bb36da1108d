"""The status of a running graph's operators, from what their processes answer: as a table, as lines, as JSON."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from dataflow.analysis.latency import PathLatency, batch_latencies
from dataflow.cli.support.output import count, milliseconds, plural, seconds
from dataflow.graph.model import Graph
from dataflow.supervision.core.health import Health, HealthMonitor
from dataflow.supervision.core.watchers.lateness import LATE, held_up_by
from dataflow.sync import FOREVER, NEVER

if TYPE_CHECKING:
    from dataflow.client.processes import MachineStatus, ProcessStatus
    from dataflow.transport.registry import RunningGraph

PATHS = 10
"""Paths of a table at most: those of the largest p99."""

_STYLES = {
    "running": "green",
    "starting": "dim",
    "ended": "dim",
    "dropping": "yellow",
    "timeout": "yellow",
    "late": "yellow",
    "silent": "bold red",
    "no answer": "bold red",
}
_NOTHING = (0, 0, 0, 0, 0, 0)


@dataclass(frozen=True, slots=True)
class Row:
    """One operator: rates in Hz, `load` the CPU time of its calls and `wall` their wall time, as shares of the time
    since the last update; `lag` event time (s) behind the foremost, `behind_clock` (s) of a source behind the clock."""

    operator: str
    process: str
    state: str
    firings: int
    emitted: int
    dropped: int
    timeouts: int
    late: int
    rate: float
    drop_rate: float
    load: float
    wall: float
    restarts: int
    lag: float | None
    behind_clock: float | None
    note: str


@dataclass(frozen=True, slots=True)
class Sample:
    """The graph at one moment: its operators, the sources behind the clock with what holds each up, the notes of
    operators, the latencies of its paths, the other machines."""

    rows: Sequence[Row]
    behind: Mapping[str, str] = field(default_factory=dict)
    notes: Sequence[str] = ()
    paths: Sequence[PathLatency] = ()
    machines: Mapping[str, MachineStatus] = field(default_factory=dict)


@dataclass(slots=True)
class StatusTable:
    """Turns what processes answer into samples; an operator whose process does not answer keeps its last counts."""

    graph: Graph
    _of: dict[str, ProcessStatus] = field(default_factory=dict)
    _monitor: HealthMonitor = field(default_factory=HealthMonitor)

    def update(self, statuses: Sequence[ProcessStatus], now: float) -> Sample:
        """`now`: seconds, never going back."""
        answered = {operator for status in statuses for operator in status.restarts}
        self._of |= {operator: status for status in statuses for operator in status.restarts}
        told = {name: self._of[name] for name in self.graph.nodes if name in self._of}
        counts = {
            name: told[name].counts.get(name, _NOTHING) if name in told else _NOTHING for name in self.graph.nodes
        }
        healths = self._monitor.update(
            counts,
            now,
            ended=frozenset(name for status in statuses for name in status.ended),
            restarts={name: status.restarts[name] for name, status in told.items()},
            waits={name: status.waits.get(name, {}) for name, status in told.items()},
        )
        lags = _lags(counts)
        rows = [_row(health, told.get(health.operator), lags, health.operator in answered) for health in healths]
        paths = batch_latencies(self.graph, (batch for status in statuses for batch in status.firings))
        found = {name: text for status in told.values() for name, text in status.found.items()}
        return Sample(rows, _late_sources(rows, told), _notes(rows, found), paths)


def _row(health: Health, status: ProcessStatus | None, lags: Mapping[str, float | None], answered: bool) -> Row:
    name = health.operator
    behind = None if status is None or name not in status.behind else max(status.behind[name])
    return Row(
        name,
        "" if status is None else status.process,
        health.state if answered else "no answer",
        health.firings,
        health.emitted,
        health.dropped,
        sum(n for (_, what), n in health.waits.items() if what == "timeout"),
        sum(n for (_, what), n in health.waits.items() if what == "late"),
        health.rate,
        health.drop_rate,
        health.load,
        health.wall,
        health.restarts,
        lags[name],
        behind,
        health.note if answered else "its process does not answer",
    )


def _lags(counts: Mapping[str, Sequence[int]]) -> dict[str, float | None]:
    """Seconds of event time by which each operator is behind the foremost; None where that cannot be said."""
    reached = {name: c[4] for name, c in counts.items() if c[0] and c[4] not in (NEVER, FOREVER)}
    front = max(reached.values(), default=0)
    return {name: (front - reached[name]) * 1e-9 if name in reached else None for name in counts}


def _late_sources(rows: Sequence[Row], told: Mapping[str, ProcessStatus]) -> dict[str, str]:
    """Names the sources that are behind the clock, and what holds each up."""
    said = {}
    for row in rows:
        if row.behind_clock is None or row.behind_clock <= LATE or row.state == "ended":
            continue
        status = told[row.operator]
        others = [name for name in status.restarts if name != row.operator]
        why = held_up_by(others, *status.behind[row.operator], row.load, row.wall)
        said[row.operator] = f"source {row.operator!r} is {seconds(row.behind_clock)} behind the clock: {why}"
    return said


def _notes(rows: Sequence[Row], found: Mapping[str, str]) -> list[str]:
    notes = [f"{row.operator}: {row.note}" for row in rows if row.note]
    return notes + [f"{row.operator}: {found[row.operator]}" for row in rows if row.operator in found]


def as_json(sample: Sample) -> dict[str, Any]:
    return {
        "operators": [asdict(row) for row in sample.rows],
        "notes": [*sample.behind.values(), *sample.notes],
        "latencies": [path.as_json() for path in sample.paths],
        "machines": {name: asdict(state) for name, state in sample.machines.items()},
    }


# A table


def shown(sample: Sample, found: RunningGraph) -> RenderableType:
    """The operators, the notes, and the slowest paths."""
    parts: list[RenderableType] = [operators_table(sample.rows, title(found.name, found.started))]
    parts += [Text(note, style="yellow") for note in (*sample.behind.values(), *sample.notes)]
    parts += [Text(machine_line(name, state)) for name, state in sample.machines.items()]
    if sample.paths:
        parts += [Text(), paths_table(sample.paths)]
    return Group(*parts)


def machine_line(name: str, state: MachineStatus) -> str:
    """Returns such as "machine robot: link up, clock +1.250 ms ± 0.300 ms"; no measurement takes no time."""
    dropped = f", {state.dropped} messages dropped" if state.dropped else ""
    measured = f"{state.offset / 1e6:+.3f} ms ± {state.delay / 2e6:.3f} ms"
    clock = f"clock {measured if state.delay else 'not measured yet'}"
    return f"machine {name}: link {'up' if state.up else 'down'}, {clock}{dropped}"


def title(name: str, started: float) -> Text:
    return Text.assemble((name, "bold"), f"  running for {seconds(time.time() - started)}")


def operators_table(rows: Sequence[Row], heading: Text) -> Table:
    """Fits 80 columns: what is nothing of all has no column, nor have processes that are their operators' own."""
    made = _bare(heading)
    made.add_column("operator", overflow="fold", min_width=8)
    shows_process = any(row.process not in ("", row.operator) for row in rows)
    if shows_process:
        made.add_column("process", overflow="ellipsis", no_wrap=True, style="dim", max_width=10)
    made.add_column("state", no_wrap=True)
    made.add_column("Hz", justify="right", no_wrap=True)
    counted = [name for name in ("dropped", "timeouts", "late") if any(getattr(row, name) for row in rows)]
    restarted = ["restarts"] if any(row.restarts for row in rows) else []
    for name in (*counted, "CPU", "wall", *restarted, "lag"):
        made.add_column(name, justify="right", no_wrap=True)
    for row in rows:
        made.add_row(
            Text(row.operator),
            *((Text("" if row.process == row.operator else row.process),) if shows_process else ()),
            Text(row.state, _STYLES.get(row.state, "")),
            f"{row.rate:.1f}",
            *(_warning(getattr(row, name)) for name in counted),
            f"{row.load:.0%}",
            f"{row.wall:.0%}",
            *(_warning(row.restarts) for _ in restarted),
            _lag(row),
        )
    return made


def paths_table(paths: Sequence[PathLatency]) -> Table:
    """The slowest paths first."""
    slowest = sorted(paths, key=lambda path: path.p99, reverse=True)[:PATHS]
    more = f", the {len(slowest)} slowest of {plural(len(paths), 'path')}" if len(paths) > len(slowest) else ""
    made = _bare(Text.assemble(("latency", "bold"), f" of the last 10 s{more}"))
    made.add_column("from", overflow="fold", min_width=8)
    made.add_column("to", overflow="fold", min_width=8)
    for name in ("p50", "p99"):
        made.add_column(name, justify="right", no_wrap=True)
    made.add_column("costs most", overflow="fold", min_width=10)
    for path in slowest:
        numbers = (milliseconds(path.p50), milliseconds(path.p99))
        made.add_row(Text(path.source), Text(path.sink), *numbers, Text(path.costliest))
    return made


def _bare(heading: Text) -> Table:
    return Table(
        title=heading, title_justify="left", box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="dim"
    )


def _warning(number: int) -> Text:
    return Text(count(number) if number else "", "yellow")


def _lag(row: Row) -> Text:
    if row.behind_clock is not None:
        return Text(seconds(row.behind_clock), "yellow" if row.behind_clock > LATE else "")
    return Text("" if row.lag is None else seconds(row.lag))


# Lines

_COLUMNS: tuple[tuple[str, str, Callable[[Row], str]], ...] = (
    ("state", "<10", lambda row: row.state),
    ("Hz", ">7", lambda row: f"{row.rate:.1f}"),
    ("dropped", ">9", lambda row: count(row.dropped)),
    ("timeouts", ">8", lambda row: count(row.timeouts)),
    ("late", ">7", lambda row: count(row.late)),
    ("CPU", ">5", lambda row: f"{row.load:.0%}"),
    ("wall", ">5", lambda row: f"{row.wall:.0%}"),
    ("restarts", ">8", lambda row: str(row.restarts)),
    ("lag", ">8", lambda row: _lag(row).plain),
)
"""Headings, widths and texts."""


def heading(sample: Sample) -> str:
    """The names of what `line` prints."""
    names = (f"{name:{width}}" for name, width, _ in _COLUMNS)
    return "  ".join((f"{'time':>8}", f"{'operator':<{_width(sample)}}", *names))


def line(row: Row, sample: Sample, running: float) -> str:
    """One operator at one moment, `running` seconds after the graph began."""
    cells = (f"{text(row):{width}}" for _, width, text in _COLUMNS)
    return "  ".join((f"{running:>8.1f}", f"{row.operator:<{_width(sample)}}", *cells)).rstrip()


def _width(sample: Sample) -> int:
    return max(len("operator"), *(len(row.operator) for row in sample.rows))
