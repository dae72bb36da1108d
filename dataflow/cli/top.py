"""`dataflow top`: the status of every operator of a running graph."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table
from rich.text import Text

from dataflow.cli.arguments import FLAG
from dataflow.cli.live import GraphName, Wait, running_graph
from dataflow.cli.output import INTERRUPTED, count, err, fail, friendly_errors, out, print_json, seconds

if TYPE_CHECKING:
    from dataflow.client.processes import HostStatus

ANSWER_WITHIN = 1.0
"""Seconds after which a process counts as silent."""
CONNECT_WITHIN = 3.0

_STYLES = {
    "running": "green",
    "starting": "dim",
    "ended": "dim",
    "dropping": "yellow",
    "silent": "bold red",
    "no answer": "bold red",
}


@dataclass(frozen=True, slots=True)
class Row:
    """One operator: rates in Hz, `load` the share of its time at work, `lag` event time (s) behind the foremost."""

    operator: str
    host: str
    state: str
    firings: int
    emitted: int
    dropped: int
    rate: float
    drop_rate: float
    load: float
    restarts: int
    lag: float | None
    note: str


@dataclass(slots=True)
class Board:
    """Turns what processes report into rows; an operator whose process does not answer keeps its last counts."""

    operators: Sequence[str]
    _hosts: dict[str, str] = field(default_factory=dict)
    _counts: dict[str, Sequence[int]] = field(default_factory=dict)
    _restarts: dict[str, int] = field(default_factory=dict)
    _monitor: Any = None

    def update(self, statuses: Sequence[HostStatus], now: float) -> list[Row]:
        """`now`: seconds, never going back."""
        from dataflow.supervision.health import HealthMonitor

        if self._monitor is None:
            self._monitor = HealthMonitor()
        answered: set[str] = set()
        ended: set[str] = set()
        for status in statuses:
            for operator, restarts in status.restarts.items():
                answered.add(operator)
                self._hosts[operator] = status.host
                self._restarts[operator] = restarts
                self._counts[operator] = status.counts.get(operator, (0, 0, 0, 0, 0))
            ended |= status.ended
        counts = {name: self._counts.get(name, (0, 0, 0, 0, 0)) for name in self.operators}
        healths = self._monitor.update(counts, now, ended=frozenset(ended), restarts=self._restarts)
        lags = _lags(counts)
        return [
            Row(
                health.operator,
                self._hosts.get(health.operator, ""),
                health.state if health.operator in answered else "no answer",
                health.firings,
                health.emitted,
                health.dropped,
                health.rate,
                health.drop_rate,
                health.load,
                health.restarts,
                lags[health.operator],
                health.note if health.operator in answered else "its process does not answer",
            )
            for health in healths
        ]


def _lags(counts: Mapping[str, Sequence[int]]) -> dict[str, float | None]:
    """Seconds of event time by which each operator is behind the foremost; None where that cannot be said."""
    from dataflow.sync import FOREVER, NEVER

    reached = {name: c[4] for name, c in counts.items() if c[0] and c[4] not in (NEVER, FOREVER)}
    front = max(reached.values(), default=0)
    return {name: (front - reached[name]) * 1e-9 if name in reached else None for name in counts}


def top(
    once: Annotated[bool, typer.Option("--once", metavar=FLAG, help="Print one table and end.")] = False,
    every: Annotated[float, typer.Option("--every", metavar="SECONDS", help="Time between two updates.")] = 1.0,
    graph: GraphName = None,
    wait: Wait = 0.0,
    json: Annotated[bool, typer.Option("--json", metavar=FLAG, help="Print one sample as JSON and end.")] = False,
) -> None:
    """Show the status of every operator of a running graph: state, rates, drops, load, restarts and lag.

    States: running, dropping (messages reached no firing), silent (nothing for a while), starting,
    ended, no answer (its process is being restarted, or hangs). Rates and load are since the last update; lag is how
    far an operator's event time is behind the foremost one's. Ends with the graph, or at Ctrl-C.

    Examples:

      dataflow top
      dataflow top --once
      dataflow top --every 0.5 --graph robot
      dataflow top --json
    """
    from rich.live import Live

    from dataflow.client.attach import graph_of, still_runs
    from dataflow.client.processes import hosts_of

    if not 0.05 <= every < 1e6:
        raise fail(f"--every {every:g}: expected seconds, 0.05 or more")
    once = once or json
    with friendly_errors():
        found = running_graph(graph, wait)
        board = Board(list(graph_of(found).nodes))
        live = Live(console=out, auto_refresh=False, transient=True) if out.is_terminal and not once else None
        try:
            with hosts_of(found) as hosts:
                hosts.connected(len(found.endpoints), CONNECT_WITHIN)
                rows = board.update(hosts.statuses(ANSWER_WITHIN), time.monotonic())
                if live is not None:
                    live.start()
                while still_runs(found):
                    time.sleep(every)
                    rows = board.update(hosts.statuses(ANSWER_WITHIN), time.monotonic())
                    if once:
                        break
                    shown = _table(rows, _title(found.name, found.started))
                    if live is not None:
                        live.update(shown, refresh=True)
                    else:
                        out.print(shown)
        except KeyboardInterrupt:
            raise typer.Exit(INTERRUPTED) from None
        finally:
            if live is not None:
                live.stop()
    if json:
        print_json({"graph": found.name, "operators": [asdict(row) for row in rows]})
    elif once or live is not None:
        out.print(_table(rows, _title(found.name, found.started)))
    if not once:
        err.print(Text(f"{found.name} has ended"))


def _title(name: str, started: float) -> Text:
    return Text.assemble((name, "bold"), f"  running for {seconds(time.time() - started)}")


def _table(rows: Sequence[Row], title: Text) -> Table:
    """Fits 80 columns; the process is named where it is not the operator's own."""
    made = Table(title=title, title_justify="left", box=None, pad_edge=False, padding=(0, 1, 0, 0), header_style="dim")
    made.add_column("operator", overflow="fold", min_width=8)
    if any(row.host not in ("", row.operator) for row in rows):
        made.add_column("process", overflow="ellipsis", no_wrap=True, style="dim", max_width=10)
    made.add_column("state", no_wrap=True)
    for heading in ("Hz", "drops/s", "dropped", "load", "restarts", "lag"):
        made.add_column(heading, justify="right", no_wrap=True)
    shows_host = len(made.columns) == 9
    for row in rows:
        host = (Text("" if row.host == row.operator else row.host),) if shows_host else ()
        made.add_row(
            Text(row.operator),
            *host,
            Text(row.state, _STYLES.get(row.state, "")),
            f"{row.rate:.1f}",
            Text(f"{row.drop_rate:.1f}", "yellow") if row.drop_rate else "",
            count(row.dropped) if row.dropped else "",
            f"{row.load:.0%}",
            Text(count(row.restarts), "yellow") if row.restarts else "",
            "" if row.lag is None else seconds(row.lag),
        )
    return made
