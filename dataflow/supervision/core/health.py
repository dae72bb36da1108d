"""Judges how every operator of a running graph fares, from its counts: what `dataflow top` shows and the recording
keeps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

State = Literal["starting", "running", "dropping", "timeout", "late", "silent", "restarting", "ended"]

LEVELS: Mapping[State, int] = {
    "starting": 0,
    "running": 0,
    "ended": 0,
    "dropping": 1,
    "timeout": 1,
    "late": 1,
    "restarting": 2,
    "silent": 3,
}
"""As in `dataflow.messages.diagnostics.Level`: 0 ok, 1 warn, 2 error, 3 stale."""

SILENT_AFTER = 1.0
"""Seconds without a firing, at least, that make an operator silent; slower ones get five of their usual periods."""


@dataclass(frozen=True, slots=True)
class Health:
    """One operator at one moment: rates in Hz; `load` the CPU time of its calls as a share of the time that has passed,
    `wall` their wall time, with whatever they waited for."""

    operator: str
    state: State
    firings: int
    emitted: int
    dropped: int
    rate: float
    drop_rate: float
    load: float
    wall: float
    restarts: int = 0
    note: str = ""
    drops: Mapping[tuple[str, str], int] = field(default_factory=dict)
    """Drops so far, by (input, reason); a source's input is ""."""
    waits: Mapping[tuple[str, str], int] = field(default_factory=dict)
    """Waits given up and messages that came late so far, by (input, "timeout" or "late")."""

    @property
    def level(self) -> int:
        return LEVELS[self.state]

    def values(self) -> dict[str, str]:
        """For a `Diagnostics` message."""
        return (
            {
                "firings": str(self.firings),
                "emitted": str(self.emitted),
                "dropped": str(self.dropped),
                "rate_hz": f"{self.rate:.2f}",
                "drop_rate_hz": f"{self.drop_rate:.2f}",
                "load": f"{self.load:.3f}",
                "wall": f"{self.wall:.3f}",
                "restarts": str(self.restarts),
            }
            | {
                ".".join(("dropped", *filter(None, (input_name, reason)))): str(count)
                for (input_name, reason), count in sorted(self.drops.items())
            }
            | {".".join((what, input_name)): str(count) for (input_name, what), count in sorted(self.waits.items())}
        )


@dataclass(slots=True)
class _Past:
    firings: int = 0
    dropped: int = 0
    cpu_ns: int = 0
    wall_ns: int = 0
    timeouts: int = 0
    late: int = 0
    moved: float = 0.0
    period: float = 0.0

    def take_pace(self, past: _Past, now: float) -> None:
        """Takes over when the operator last fired, and its usual period (s)."""
        self.moved, self.period = past.moved, past.period
        if fired := self.firings - past.firings:
            period = (now - past.moved) / fired
            self.period = period if not past.period else 0.7 * past.period + 0.3 * period
            self.moved = now


@dataclass(slots=True)
class HealthMonitor:
    """Turns counts, taken every now and then, into health. Times are seconds, never going back."""

    _past: dict[str, _Past] = field(default_factory=dict)
    _taken: float | None = None

    def update(
        self,
        counts: Mapping[str, Sequence[int]],
        now: float,
        *,
        away: Mapping[str, str] | None = None,
        ended: frozenset[str] = frozenset(),
        restarts: Mapping[str, int] | None = None,
        drops: Mapping[str, Mapping[tuple[str, str], int]] | None = None,
        waits: Mapping[str, Mapping[tuple[str, str], int]] | None = None,
    ) -> list[Health]:
        """Returns the health of every operator since the last call.

        `counts`: per operator firings, emitted, dropped, CPU time (ns), last stamp, wall time (ns), as processes report
        them. `away`: those that are being restarted, and why; `restarts`: how often each was; `drops`: how many, by
        (input, reason); `waits`: how many, by (input, "timeout" or "late").
        """
        span = 0.0 if self._taken is None else now - self._taken
        self._taken = now
        found = []
        for name, (firings, emitted, dropped, cpu_ns, _, wall_ns) in counts.items():
            waited = dict((waits or {}).get(name, {}))
            fresh = _Past(firings, dropped, cpu_ns, wall_ns, _sum(waited, "timeout"), _sum(waited, "late"), now)
            past = self._past.get(name, fresh)
            if firings < past.firings:  # a new process counts from nothing
                past = _Past(moved=past.moved, period=past.period)
            fresh.take_pace(past, now)
            silence = now - fresh.moved
            state, note = _activity(past, fresh, span)
            if name in ended:
                state, note = "ended", ""
            elif away and name in away:
                state, note = "restarting", away[name]
            elif not firings:
                state, note = "starting", ""
            elif silence > max(SILENT_AFTER, 5 * fresh.period):
                state, note = "silent", f"nothing for {silence:.1f} s"
            self._past[name] = fresh
            health = Health(
                name,
                state,
                firings,
                emitted,
                dropped,
                rate=(firings - past.firings) / span if span else 0.0,
                drop_rate=max(0, dropped - past.dropped) / span if span else 0.0,
                load=_share(cpu_ns - past.cpu_ns, span),
                wall=_share(wall_ns - past.wall_ns, span),
                restarts=(restarts or {}).get(name, 0),
                note=note,
                drops=dict((drops or {}).get(name, {})),
                waits=waited,
            )
            found.append(health)
        return found


def _activity(past: _Past, now: _Past, span: float) -> tuple[State, str]:
    """The state of an operator that fires, and a note: drops come before timeouts, these before lateness."""
    if (lost := now.dropped - past.dropped) > 0:
        return "dropping", f"{lost} dropped in {span:.1f} s"
    if (given_up := now.timeouts - past.timeouts) > 0:
        return "timeout", f"{given_up} waits for an input given up in {span:.1f} s"
    if (late := now.late - past.late) > 0:
        return "late", f"{late} messages in {span:.1f} s came after their firing"
    return "running", ""


def _sum(waits: Mapping[tuple[str, str], int], kind: str) -> int:
    return sum(number for (_, what), number in waits.items() if what == kind)


def _share(nanoseconds: int, span: float) -> float:
    return min(1.0, max(0, nanoseconds) * 1e-9 / span) if span else 0.0


def diagnostics_fields(healths: Sequence[Health], stamp: int) -> dict[str, Any]:
    """Plain values of a `Diagnostics` message."""
    return {
        "stamp": stamp,
        "names": [h.operator for h in healths],
        "messages": [h.note or h.state for h in healths],
        "levels": [h.level for h in healths],
        "values": [{"state": h.state, **h.values()} for h in healths],
    }
