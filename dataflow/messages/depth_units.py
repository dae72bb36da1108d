"""The unit of 16-bit depth, as far as the distances show it: depth cameras see neither the lens nor the horizon."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

NEAREST, FARTHEST = 0.3, 10.0
"""Metres between which depth cameras measure most of what they see."""
NARROW = 1.0
"""Metres within which no whole recording of a room lies."""
MILLIMETRES, FIFTHS = 1000.0, 5000.0
"""Units a metre of nearly all 16-bit depth: millimetres, and those of the TUM RGB-D dataset."""
INVALID = (0, 65535)
"""Values of no return: none, and saturated."""

Verdict = Literal["own", "other", "either", "neither"]


class DepthSpan(NamedTuple):
    """Quantiles of depths, metres: 5, 50 and 90 %."""

    low: float
    median: float
    high: float

    @classmethod
    def of(cls, raw: NDArray[np.uint16] | NDArray[np.float32], scale: float) -> DepthSpan | None:
        """The span of raw values, `scale` a metre, of any shape; None where all are invalid."""
        valid = raw[np.isfinite(raw) & (raw > INVALID[0]) & (raw < INVALID[1])]
        return cls(*(float(q) / scale for q in np.quantile(valid, (0.05, 0.5, 0.9)))) if valid.size else None

    def times(self, factor: float) -> DepthSpan:
        """The span of depths that are `factor` times as large."""
        return DepthSpan(*(factor * metres for metres in self))

    @property
    def seen(self) -> bool:
        """A depth camera sees all of it."""
        return self.low >= NEAREST and self.high <= FARTHEST

    def judged(self, factor: float) -> Verdict:
        """Judges whether these are depths of a depth camera (`own`), or `factor` times these (`other`).

        Doubt is in favour of these: stereo sees farther than `FARTHEST`, a camera at a wall is nearer than `NEAREST`.
        """
        other = self.times(factor)
        if self.seen:
            return "either" if other.seen else "own"
        if not other.seen:
            return "neither"
        too_near = self.median < NEAREST or (self.low < NEAREST and self.high < NARROW)
        return "other" if too_near or self.median > FARTHEST else "either"

    def doubt(self) -> str:
        """Returns which other unit would make these the depths of a depth camera; empty where none would."""
        if self.judged(MILLIMETRES / FIFTHS) == "other":
            there = self.times(MILLIMETRES / FIFTHS)
            return f"depth is {self}, most of it farther than depth cameras see; with 5000 units a metre it is {there}"
        if self.judged(FIFTHS / MILLIMETRES) == "other":
            there = self.times(FIFTHS / MILLIMETRES)
            return f"depth is {self}, nearer than depth cameras see; if its units were millimetres, it is {there}"
        return ""

    def __str__(self) -> str:
        return f"{self.low:.2g} to {self.high:.2g} m"
