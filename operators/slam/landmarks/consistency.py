"""Consistency of landmark SLAM: innovations against their covariance, and landmarks against their expected places.

From the innovations follows how much noisier the odometry is than it was set to be (covariance matching: Mehra, "On
the identification of variances and adaptive Kalman filtering", 1970). Where landmarks are not seen at their places, and
others are in between, the robot is lost.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

_KEPT = 0.995
"""Share of the sums that remains at each message: they are of about 200 messages."""
_SIGNIFICANT = 3.0
_KNOWN = 3.0
"""Standard deviation, over the given one, up to which the odometry's variance as innovations show it counts: where
sightings outweigh the motion, chance decides it."""
_MOST = 100.0
"""Variance of the odometry over the given one, at most."""
_FEW, _LOST = 2, 3
"""Landmarks not at their places, where fewer are, and messages of such by which a robot is lost."""


@dataclass
class Consistency:
    """Running sums over the last messages with sightings."""

    nis: float = 0.0
    """Sum of normalised innovations squared, before any was refused."""
    freedom: float = 0.0
    motion: float = 0.0
    """Part of the freedom that the odometry's noise since the sighting before makes up."""
    variance: float = 0.0
    """Sum of the odometry's variance as innovations show it, over the given one, weighted by `motion`."""
    spread: float = 0.0
    """Variance of `variance` by chance."""
    strayed: int = 0
    """Last messages in a row by which most landmarks are not at their places, while others are seen there."""

    @property
    def odometry_variance(self) -> float:
        """Variance of the odometry over the given one; 1 unless it is larger beyond chance."""
        known = self.freedom > 0 and math.sqrt(2 * self.freedom) <= _KNOWN * self.motion
        if not known or self.variance - _SIGNIFICANT * math.sqrt(self.spread) <= self.motion:
            return 1.0
        return min(_MOST, self.variance / self.motion)

    @property
    def ratio(self) -> float:
        """Innovations squared over their expectation, 1 at least: what is beyond chance."""
        if self.freedom <= 0:
            return 1.0
        return max(1.0, (self.nis - _SIGNIFICANT * math.sqrt(self.freedom)) / self.freedom)

    @property
    def lost(self) -> bool:
        return self.strayed >= _LOST

    def update(self, nis: float, freedom: int, motion: float) -> None:
        """Takes the joint innovation of one message, and the part of its freedom that is the odometry's."""
        told = self.odometry_variance
        self.nis = _KEPT * self.nis + nis
        self.freedom = _KEPT * self.freedom + freedom
        self.motion = _KEPT * self.motion + motion
        self.variance = _KEPT * self.variance + told * (motion + nis - freedom)
        self.spread = _KEPT**2 * self.spread + told**2 * 2 * freedom

    def look(self, matched: int, strayed: int) -> None:
        """Takes how many landmarks were seen at their places, and how many were not while others were seen."""
        self.strayed = self.strayed + 1 if strayed >= _FEW and strayed > matched else 0
