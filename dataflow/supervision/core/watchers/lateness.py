"""Sources of a live run against the clock: which fall behind it, and which wait for it without end.

A source that can wait (a data set, a simulator) is read at the pace of the clock. Where that takes longer than real
time, event time falls behind, and everything after it looks healthy; so it is said, at once and at the end.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from dataflow.supervision.core.run_state import RunState
from dataflow.supervision.core.supervised import Supervised
from dataflow.supervision.core.watchers.watcher import Watcher

LATE = 1.0
"""Seconds behind the clock that are worth a word."""
ITS_OWN = 0.5
"""Share of its lateness that a source must have when it is read, to be the one that is slow."""
AT_WORK = 0.7
"""CPU time of a source, as a share of the time that has passed, from which reading it takes longer than real time."""
STANDSTILL = 0.5
"""Seconds that the clock is further ahead of the supervisor's own from which the machine stood still, or it was set."""
ON_THE_WAY = 1.0
"""Seconds after a standstill within which what a source reports may be from before it."""
IDLE = 0.05
"""Share of CPU time in the time that reading takes, up to which it does nothing but wait."""


def held_up_by(others: Sequence[str], read: float, sent: float, load: float, wall: float) -> str:
    """Names what holds a source up.

    `others`: the other operators of its process; `read`, `sent`: seconds by which its last message was late when it was
    read, and when it was sent; `load`, `wall`: CPU time and time that reading it took, as shares of what has passed.
    """
    named = ", ".join(others)
    if read < ITS_OWN * sent:
        return f"its process is busy with {named or 'sending'}"
    if load > AT_WORK:
        return "reading it takes longer than real time"
    computes = min(1.0, load / wall) if wall > 0 else 0.0
    if computes <= IDLE:
        return "reading it waits, for a device or a file, and computes next to nothing"
    beside = f"with {named}, its process's others" if named else "with other processes"
    return (
        f"reading it computes for {computes:.0%} of the time that it takes, and for the rest it waits: for a device or "
        f"a file, or for the CPU, which it shares {beside}"
    )


def how_long(seconds: float) -> str:
    """Returns a span in words, however long it is."""
    for unit, length in (("years", 365.25 * 86400), ("days", 86400.0), ("hours", 3600.0)):
        if seconds >= 2 * length:
            return f"{seconds / length:.3g} {unit}"
    return f"{seconds:.0f} s"


class Lateness(Watcher):
    """Takes in how late each source's last message was, in s: when it was read, and when it was sent."""

    def __init__(self, run: RunState) -> None:
        super().__init__(run)
        self._late: dict[str, float] = {}
        self._worst: dict[str, float] = {}
        self._said: set[str] = set()
        self._excused = dict.fromkeys((node.name for node in run.graph.sources()), 0.0)
        """By source, of its lateness what no source is to blame for: the machine stood still."""
        self._ahead = self._stood_at = 0.0

    def released(self) -> None:
        self._ahead = self.run.now.wall - self.run.steady

    def said(self, process: Supervised, kind: str, fields: Mapping[str, Any]) -> None:
        if kind == "progress":
            for source, (read, sent) in fields.get("behind", {}).items():
                self._take(process, source, read, sent)
        elif kind == "early":
            self._waits(fields["operator"], fields["last"], fields["stamp"], fields["seconds"])

    def _take(self, process: Supervised, source: str, read: float, sent: float) -> None:
        self.run.status.behind[source] = max(read, sent)
        excused = self._excuse(source, max(read, sent))
        read, sent = max(0.0, read - excused), max(0.0, sent - excused)
        late = self._late[source] = max(read, sent)
        self._worst[source] = max(late, self._worst.get(source, 0.0))
        if late > LATE and source not in self._said:
            self._said.add(source)
            why = self._why(process, source, read, sent)
            self.run.event("behind", f"source {source!r} has fallen behind the clock: {why}", operator=source)
        elif late < LATE / 2:
            self._said.discard(source)

    def _excuse(self, source: str, behind: float) -> float:
        """Returns how much of its lateness no source is to blame for; less as it catches up."""
        ahead, steady = self.run.now.wall - self.run.steady, self.run.steady
        if abs(stood := ahead - self._ahead) > STANDSTILL:
            self._ahead, self._stood_at = ahead, steady
            self._excused = {name: max(0.0, excused + stood) for name, excused in self._excused.items()}
        if steady - self._stood_at > ON_THE_WAY:
            self._excused[source] = min(self._excused[source], behind)
        return self._excused[source]

    def _why(self, process: Supervised, source: str, read: float, sent: float) -> str:
        run = self.run
        assert run.release is not None
        elapsed = max(run.steady - run.release.at.steady, 1e-9)
        counts = run.status.operators[source]
        load, wall = (ns * 1e-9 / elapsed for ns in (counts.cpu_ns, counts.wall_ns))
        return held_up_by([name for name in process.nodes if name != source], read, sent, load, wall)

    def _waits(self, source: str, last: int | None, stamp: int, seconds: float) -> None:
        jump = "" if last is None else f", its stamps jump from {last} to {stamp}"
        rate = "" if self.run.plan.rate in (None, 1.0) else f" at rate {self.run.plan.rate:g}"
        text = f"source {source!r} waits {how_long(seconds)} for the clock{rate}{jump}: nothing comes until then"
        self.run.event("clock_wait", text, operator=source, stamp=stamp, seconds=seconds)

    def closing(self) -> None:
        for source, late in sorted(self._late.items()):
            if (worst := self._worst[source]) > LATE:
                self.run.note(f"source {source!r} was {late:.1f} s behind the clock at the end, {worst:.1f} s at most")
