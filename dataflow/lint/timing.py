"""Timestamps of one stream: order, rate, gaps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dataflow.lint.inputs import Finding, Stamps

GAP = 2.5
"""Periods without a message that are a gap, in a stream that has a rate."""
STEADY = 0.35
"""The spread of the intervals, as a share of the period, up to which a stream has a rate."""
FEWEST = 8
"""Messages from which on a stream can have a rate."""
FASTEST = 10_000.0
"""Hz; inertial sensors, the fastest, have up to 8,000."""
APART = 1.0
"""Seconds by which a stream may begin later or end earlier than the others."""


@dataclass(frozen=True, slots=True)
class Timing:
    """`period` (s) is the median interval; `spread` (s) half the range that holds the middle 80 % of the intervals."""

    count: int
    first: int
    last: int
    period: float
    spread: float
    longest: float

    @property
    def steady(self) -> bool:
        """Returns whether it has a rate at all: events come when they come."""
        return self.count >= FEWEST and self.period > 0 and self.spread <= STEADY * self.period

    @property
    def rate(self) -> float:
        """Hz, by the median interval."""
        return 1.0 / self.period if self.period > 0 else 0.0


def timing_of(stamps: Stamps) -> Timing | None:
    """The timing of a stream; None for an empty one."""
    if len(stamps) == 0:
        return None
    intervals = np.diff(np.unique(stamps)) * 1e-9
    if len(intervals) == 0:
        return Timing(len(stamps), int(stamps.min()), int(stamps.max()), 0.0, 0.0, 0.0)
    low, middle, high = np.quantile(intervals, [0.1, 0.5, 0.9])
    return Timing(
        len(stamps), int(stamps.min()), int(stamps.max()), float(middle), float(high - low) / 2, float(intervals.max())
    )


def check_order(stream: str, stamps: Stamps) -> Iterator[Finding]:
    """Timestamps that repeat or go back."""
    steps = np.diff(stamps)
    if (again := np.flatnonzero(steps == 0)).size:
        text = f"{again.size:,} timestamps are that of the message before"
        yield Finding("duplicate", stream, "error", text, int(stamps[again[0]]), {"messages": int(again.size)})
    if (back := np.flatnonzero(steps < 0)).size:
        largest = float(-steps[back].min()) * 1e-9
        text = f"{back.size:,} timestamps go back, by up to {_seconds(largest)}"
        values = {"messages": int(back.size), "largest_s": largest}
        yield Finding("backward", stream, "error", text, int(stamps[back[0] + 1]), values)


def check_unit(stream: str, timing: Timing) -> Iterator[Finding]:
    """A rate that no sensor has, as of timestamps in micro- or milliseconds that are read as nanoseconds."""
    if timing.steady and timing.rate > FASTEST:
        text = f"{timing.rate:,.0f} messages a second: are its timestamps in micro- or milliseconds? ns is wanted"
        yield Finding("unit", stream, "warning", text, timing.first, {"rate_hz": timing.rate})


def check_gaps(stream: str, stamps: Stamps, timing: Timing, longest: float | None = None) -> Iterator[Finding]:
    """Intervals longer than `longest` (s), by default 2.5 periods of a stream that has a rate."""
    if longest is None:
        if not timing.steady:
            return
        longest = GAP * timing.period
    ordered = np.unique(stamps)
    intervals = np.diff(ordered) * 1e-9
    gaps = np.flatnonzero(intervals > longest * (1 + 1e-9))
    if not gaps.size:
        return
    worst = gaps[int(np.argmax(intervals[gaps]))]
    missing = round(float(intervals[gaps].sum()) / timing.period - gaps.size) if timing.steady else 0
    text = f"{gaps.size:,} gap{'s' * (gaps.size > 1)}, the longest {_seconds(float(intervals[worst]))}"
    text += f"; about {missing:,} messages are missing" if missing else ""
    values: dict[str, float | int | str] = {
        "gaps": int(gaps.size),
        "longest_s": float(intervals[worst]),
        "missing": missing,
    }
    yield Finding("gap", stream, "warning", text, int(ordered[worst]), values)


def check_ends(timings: dict[str, Timing]) -> Iterator[Finding]:
    """Streams with a rate that begin much later or end much earlier than the recording does."""
    steady = {name: timing for name, timing in timings.items() if timing.steady}
    if len(steady) < 2:
        return
    first, last = min(t.first for t in steady.values()), max(t.last for t in steady.values())
    for name, timing in steady.items():
        allowed = max(APART, GAP * timing.period)
        if (late := (timing.first - first) * 1e-9) > allowed:
            yield Finding("begins", name, "warning", f"begins {_seconds(late)} later", timing.first, {"late_s": late})
        if (early := (last - timing.last) * 1e-9) > allowed:
            yield Finding("ends", name, "warning", f"ends {_seconds(early)} early", timing.last, {"early_s": early})


def _seconds(duration: float) -> str:
    return f"{duration:.3g} s" if duration >= 1 else f"{duration * 1e3:.3g} ms"
