"""The scale of a monocular map: unknown, or learnt from what measures metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from dataflow.messages.geometry import invert
from operators.geometry.se3 import Matrix
from operators.odometry.mono.map import View

FEWEST_METRES = 0.08  # that the reference must have moved before it is used
WANDER = 0.01  # share by which the map's scale may go wrong from keyframe to keyframe
ROUGH = 0.01  # metres that the reference may be off over any way
LARGEST = 1.3  # factor by which one correction may change a known scale


@dataclass(frozen=True)
class Scale:
    """Uncertainty of the map's unit as a metre: standard deviation of its logarithm, infinite if not known at all.

    `past` is the same of the way so far, beside that: it came about with a unit that was found to be another.
    """

    sigma: float = float("inf")
    past: float = 0.0

    @property
    def known(self) -> bool:
        return bool(np.isfinite(self.sigma))

    def corrected(self, views: Sequence[View], share: float) -> tuple[float, Scale]:
        """Returns the factor that brings the map to metres, by the ways between its newest views, and the scale then.

        `share`: standard deviation of the reference's ways.
        """
        believed = replace(self, sigma=float(np.hypot(self.sigma, WANDER))) if self.known else self
        told = ratio(views)
        if told is None:
            return 1.0, believed
        factor, metres = told
        return believed.weighed(factor, float(np.hypot(share, ROUGH / metres)), share)

    def weighed(self, factor: float, sigma: float, share: float) -> tuple[float, Scale]:
        """Returns the factor that brings the map to metres, and the scale then, where a source measured one.

        `sigma`: standard deviation of the logarithm of that measurement; `share`: the part of it that stays the same
        from one to the next.
        """
        if not self.known:
            return factor, Scale(sigma)
        gain = self.sigma**2 / (self.sigma**2 + sigma**2)
        step = float(np.clip(factor, 1.0 / LARGEST, LARGEST) ** gain)
        # A source's own error of scale is no fresh one each time: nothing gets surer by it than that.
        return step, replace(self, sigma=max(float(np.sqrt(1.0 - gain)) * self.sigma, min(share, self.sigma)))


def ratio(views: Sequence[View]) -> tuple[float, float] | None:
    """Returns metres by map unit over the ways between views, and the metres; None where they are too few."""
    dot, square, metres = 0.0, 0.0, 0.0
    for a, b in pairwise(views):
        if a.T_reference is None or b.T_reference is None:
            continue
        seen = (invert(a.T_world_camera) @ b.T_world_camera)[:3, 3]
        told = (invert(a.T_reference) @ b.T_reference)[:3, 3]
        dot, square = dot + float(seen @ told), square + float(seen @ seen)
        metres += float(np.linalg.norm(told))
    if metres < FEWEST_METRES or dot <= 0.2 * metres * np.sqrt(square / max(len(views) - 1, 1)):
        return None
    return dot / square, metres


def way(T_a: Matrix | None, T_b: Matrix | None) -> float:
    """Returns the metres between two places of the reference, 0 where one is not known."""
    return 0.0 if T_a is None or T_b is None else float(np.linalg.norm(T_b[:3, 3] - T_a[:3, 3]))
