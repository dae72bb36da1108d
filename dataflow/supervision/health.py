"""How every operator of a running graph fares, from its counts: what `dataflow top` shows and the recording keeps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

State = Literal["starting", "running", "dropping", "silent", "restarting", "ended"]

LEVELS: Mapping[State, int] = {"starting": 0, "running": 0, "ended": 0, "dropping": 1, "restarting": 2, "silent": 3}
"""As in `dataflow.messages.diagnostics.Level`: 0 ok, 1 warn, 2 error, 3 stale."""

SILENT_AFTER = 1.0
"""Seconds without a firing, at least, that make an operator silent; slower ones get five of their usual periods."""


@dataclass(frozen=True, slots=True)
class Health:
    """One operator at one moment: rates in Hz, `load` the share of its time at work, `lag` seconds of event time."""

    operator: str
    state: State
    firings: int
    emitted: int
    dropped: int
    rate: float
    drop_rate: float
    load: float
    restarts: int = 0
    note: str = ""
    drops: Mapping[tuple[str, str], int] = field(default_factory=dict)
    """What was dropped so far, by (input, reason); a source's input is ""."""
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
    busy_ns: int = 0
    moved: float = 0.0
    period: float = 0.0


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
        """`counts`: per operator firings, emitted, dropped, nanoseconds of work, as hosts report them. `away`: those
        that are being started again, and why; `restarts`: how often each was; `drops`: how many, by (input, reason);
        `waits`: how many, by (input, "timeout" or "late")."""
        span = 0.0 if self._taken is None else now - self._taken
        self._taken = now
        found = []
        for name, (firings, emitted, dropped, busy_ns, *_) in counts.items():
            past = self._past.get(name)
            if past is None:
                past = self._past[name] = _Past(firings, dropped, busy_ns, now)
            if firings < past.firings:  # a new process counts from nothing
                past.firings = past.dropped = past.busy_ns = 0
            fired, lost = firings - past.firings, max(0, dropped - past.dropped)
            if fired:
                period = (now - past.moved) / fired
                past.period = period if not past.period else 0.7 * past.period + 0.3 * period
                past.moved = now
            silence = now - past.moved
            state: State = "running"
            note = ""
            if name in ended:
                state = "ended"
            elif away and name in away:
                state, note = "restarting", away[name]
            elif not firings:
                state = "starting"
            elif silence > max(SILENT_AFTER, 5 * past.period):
                state, note = "silent", f"nothing for {silence:.1f} s"
            elif lost:
                state, note = "dropping", f"{lost} dropped in {span:.1f} s"
            rate = fired / span if span else 0.0
            load = min(1.0, max(0, busy_ns - past.busy_ns) * 1e-9 / span) if span else 0.0
            past.firings, past.dropped, past.busy_ns = firings, dropped, busy_ns
            count = (restarts or {}).get(name, 0)
            drop_rate = lost / span if span else 0.0
            why = dict((drops or {}).get(name, {}))
            waited = dict((waits or {}).get(name, {}))
            health = Health(name, state, firings, emitted, dropped, rate, drop_rate, load, count, note, why, waited)
            found.append(health)
        return found


def diagnostics_fields(healths: Sequence[Health], stamp: int) -> dict[str, Any]:
    """Plain values of a `Diagnostics` message."""
    return {
        "stamp": stamp,
        "names": [h.operator for h in healths],
        "messages": [h.note or h.state for h in healths],
        "levels": [h.level for h in healths],
        "values": [{"state": h.state, **h.values()} for h in healths],
    }
