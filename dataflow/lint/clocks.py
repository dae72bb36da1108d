"""Offset and drift between the clocks of two streams that see the same turning.

The turning of one stream is integrated, so that what the other should have seen in its intervals is known for every
shift of its timestamps: the right shift makes both most alike, by their correlation. Windows of the recording give a
first line through shifts that change, which the whole then refines.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize

from dataflow.lint.turning import Turning

F64 = npt.NDArray[np.float64]

MOST = 1.0
"""Seconds of offset that are looked for."""
ALIKE = 0.6
"""Correlation below which nothing is said: too little turning, or something else moves."""
FEWEST = 40
"""Intervals that both must have seen."""
SHORTEST = 8.0
"""Seconds for which both must have been seen: within fewer, one slow swing fits another at many shifts."""
STEEPEST = 0.02
"""Drift (s/s) above which it is not the clock that differs: crystals are off by 1e-4, and 2 % is no clock at all."""
WINDOW = 8.0
"""Seconds of a window, at least; there are at most WINDOWS."""
WINDOWS = 12
CORRELATED = 2.0
"""By how much the spread of an estimate is widened: neighbouring errors are alike."""


@dataclass(frozen=True, slots=True)
class ClockDifference:
    """The lateness of a stream's timestamps against another's: `offset` (s) in the middle, growing by `drift` (s/s).

    Positive: what both saw at once has the later timestamp in this stream. Deviations are standard deviations.
    `duration` (s) is how long both were seen, `likeness` their correlation.
    """

    offset: float
    offset_deviation: float
    drift: float
    drift_deviation: float
    duration: float
    likeness: float

    def at_beginning(self) -> float:
        return self.offset - self.drift * self.duration / 2

    def minus(self, other: ClockDifference) -> ClockDifference:
        """The difference to what `other` is about, where both are to a third."""
        return ClockDifference(
            self.offset - other.offset,
            float(np.hypot(self.offset_deviation, other.offset_deviation)),
            self.drift - other.drift,
            float(np.hypot(self.drift_deviation, other.drift_deviation)),
            max(self.duration, other.duration),
            min(self.likeness, other.likeness),
        )


NONE = ClockDifference(0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def clock_difference(stream: Turning, reference: Turning, most: float = MOST) -> ClockDifference | None:
    """The lateness of `stream` against `reference`; None where their turning does not determine it."""
    seen = _Seen(stream, reference)
    if seen.usable < FEWEST or seen.duration < SHORTEST:
        return None
    offset = seen.best_offset(np.ones(len(stream.ends), bool), most)
    starts = [(offset, 0.0)]
    if (line := seen.line_through_windows(most)) is not None:
        starts.append(line)
    step = max(stream.period, reference.period, 0.01)
    found = [
        minimize(
            lambda x: -seen.likeness(x[0], x[1]),
            start,
            method="Nelder-Mead",
            options={"initial_simplex": _simplex(start, step, seen.duration), "xatol": 1e-6, "fatol": 1e-9},
        )
        for start in starts
    ]
    best = min(found, key=lambda result: float(result.fun))
    offset, drift = float(best.x[0]), float(best.x[1])
    likeness = seen.likeness(offset, drift)
    if likeness < ALIKE or abs(offset) > most or abs(drift) > STEEPEST:
        return None
    deviations = seen.deviations(offset, drift)
    if deviations is None:
        return None
    return ClockDifference(offset, deviations[0], drift, deviations[1], seen.duration, likeness)


def _simplex(start: tuple[float, float], step: float, duration: float) -> F64:
    offset, drift = start
    return np.array([[offset, drift], [offset + step, drift], [offset, drift + step / max(duration, 1.0)]])


class _Seen:
    """A stream's rates, and those expected from the reference for a shift of the stream's timestamps."""

    def __init__(self, stream: Turning, reference: Turning) -> None:
        ends = np.concatenate([reference.begins[:1], reference.ends])
        self._times = ends
        turned = reference.rates * (reference.ends - reference.begins)
        self._turned = np.concatenate([[0.0], np.cumsum(turned)])
        self._begins, self._ends, self._rates = stream.begins, stream.ends, stream.rates
        inside = (stream.begins >= ends[0]) & (stream.ends <= ends[-1])
        self.usable = int(inside.sum())
        times = stream.ends[inside]
        self.duration = float(times[-1] - stream.begins[inside][0]) if self.usable else 0.0
        self._middle = float(times.mean()) if self.usable else 0.0
        self._step = min(max(min(stream.period, reference.period) / 2, 0.002), 0.02)

    def _expected(self, offset: float, drift: float) -> tuple[F64, npt.NDArray[np.bool_]]:
        """The reference's rotation in the stream's intervals, and which of them it was there for."""
        begins = self._begins - offset - drift * (self._begins - self._middle)
        ends = self._ends - offset - drift * (self._ends - self._middle)
        there = (begins >= self._times[0]) & (ends <= self._times[-1])
        turned = np.interp(ends, self._times, self._turned) - np.interp(begins, self._times, self._turned)
        return turned / np.maximum(ends - begins, 1e-9), there

    def likeness(self, offset: float, drift: float, chosen: npt.NDArray[np.bool_] | None = None) -> float:
        """The correlation; −1 where too little is left to compare."""
        expected, there = self._expected(offset, drift)
        if chosen is not None:
            there &= chosen
        if there.sum() < max(FEWEST // 2, (len(there) if chosen is None else chosen.sum()) // 4):
            return -1.0
        a, b = expected[there], self._rates[there]
        a, b = a - a.mean(), b - b.mean()
        norm = float(np.sqrt((a @ a) * (b @ b)))
        return float(a @ b) / norm if norm > 0 else -1.0

    def best_offset(self, chosen: npt.NDArray[np.bool_], most: float) -> float:
        offsets = np.arange(-most, most + self._step, self._step)
        return float(offsets[int(np.argmax([self.likeness(offset, 0.0, chosen) for offset in offsets]))])

    def line_through_windows(self, most: float) -> tuple[float, float] | None:
        """(offset in the middle, drift) by the median of the slopes between windows."""
        first, last = float(self._begins[0]), float(self._ends[-1])
        number = min(int((last - first) / WINDOW), WINDOWS)
        if number < 2:
            return None
        edges = np.linspace(first, last, number + 1)
        found = []
        for low, high in pairwise(edges.tolist()):
            chosen = (self._begins >= low) & (self._ends <= high)
            offset = self.best_offset(chosen, most)
            if self.likeness(offset, 0.0, chosen) >= ALIKE:
                found.append(((low + high) / 2, offset))
        if len(found) < 2:
            return None
        times, offsets = np.array(found).T
        slopes = [
            (offsets[j] - offsets[i]) / (times[j] - times[i])
            for i in range(len(times))
            for j in range(i + 1, len(times))
        ]
        drift = float(np.median(slopes))
        return float(np.median(offsets - drift * (times - self._middle))), drift

    def deviations(self, offset: float, drift: float) -> tuple[float, float] | None:
        """Standard deviations of both, from the residuals of the best fit; None where it does not hold them."""
        expected, there = self._expected(offset, drift)
        nudge = self._step / 2
        slope = (self._expected(offset + nudge, drift)[0] - self._expected(offset - nudge, drift)[0]) / (2 * nudge)
        times = (self._begins + self._ends) / 2 - self._middle
        a, b = expected[there], self._rates[there]
        scale = float((a - a.mean()) @ (b - b.mean())) / max(float((a - a.mean()) @ (a - a.mean())), 1e-12)
        residuals = (b - b.mean()) - scale * (a - a.mean())
        columns = [scale * slope[there], scale * slope[there] * times[there], a, np.ones_like(a)]
        jacobian = np.stack(columns, axis=1)
        variance = float(residuals @ residuals) / max(len(b) - 4, 1)
        try:
            covariance = variance * np.linalg.inv(jacobian.T @ jacobian)
        except np.linalg.LinAlgError:
            return None
        return CORRELATED * float(np.sqrt(covariance[0, 0])), CORRELATED * float(np.sqrt(covariance[1, 1]))


def agreed(differences: Mapping[str, ClockDifference], tolerance: float) -> str:
    """Returns the stream that best represents the clock of the majority, by lateness against a common reference.

    A stream counts by how surely its lateness is known, so one that fits anything decides nothing. Of two that weigh
    the same, the one with the reference wins.
    """
    best, weight = "", 0.0
    for name, centre in differences.items():
        near = {other: each for other, each in differences.items() if _agree(each, centre, tolerance)}
        total = sum(min(1.0, tolerance / (2 * each.offset_deviation + 1e-9)) for each in near.values())
        if total > weight * (1 + 1e-6):
            surest = min(near, key=lambda other: near[other].offset_deviation)
            best, weight = surest if centre is not NONE else name, total
    return best


def _agree(one: ClockDifference, centre: ClockDifference, tolerance: float) -> bool:
    """Returns whether one fits a centre, as far as its own uncertainty goes: an uncertain centre would fit them all."""
    apart = abs(one.offset - centre.offset) + abs(one.drift - centre.drift) * one.duration / 2
    return apart <= tolerance + 2 * one.offset_deviation + one.drift_deviation * one.duration
