"""Compares the motion of one body by several sensors, and names the outlier."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert
from dataflow.operator import Remembered
from operators.geometry import se3

Array = NDArray[np.float64]

_SLIDE, _SPIN = 0.008, np.deg2rad(0.2)  # standard deviations of a window's motion: m, rad
_ROUGH_SPIN = np.deg2rad(1.5)  # the same of a sensor that measures turns only coarsely: wheels
_KNEE = 4.0  # standard deviations beyond which a residual counts linearly
_PRIOR = np.diag(1.0 / np.array([0.2, 0.2, 0.2, 0.3, 0.3]) ** 2)  # information before: of rad, and of shares
_KEEP = 0.95  # share of what is known that is kept at every window
_SPAN, _GAP = 3_000_000_000, 350_000_000  # ns: poses kept, and the longest step between two of them
_SURE = 3.0  # standard deviations by which a disagreement must stand out


@dataclass(frozen=True)
class Limits:
    """Holds what counts as a disagreement: shares of a way, of a turn, of a coarse turn, and an angle (rad)."""

    way: float
    turn: float
    coarse_turn: float
    angle: float


@dataclass(frozen=True)
class Window:
    """Holds a sensor's motion in a window: a twist (6,), metres and rad, NaN where it measures none."""

    twist: Array
    coarse: bool = False


@dataclass
class Pair:
    """Adds up, window by window, how the motions of one sensor differ from another's, and forgets."""

    coarse: bool
    information: Array = field(default_factory=_PRIOR.copy)
    gain: Array = field(default_factory=lambda: np.zeros(5))

    def add(self, a: Array, b: Array) -> None:
        """Takes the twists (6,) of the first and the second sensor over the same window."""
        self.information = _PRIOR + _KEEP * (self.information - _PRIOR)
        self.gain = _KEEP * self.gain
        spin = _ROUGH_SPIN if self.coarse else _SPIN
        for part, sigma, column in ((slice(0, 3), _SLIDE, 3), (slice(3, 6), spin, 4)):
            first, second = a[part], b[part]
            if not (np.isfinite(first).all() and np.isfinite(second).all()):
                continue
            mean = 0.5 * (first + second)
            J = np.zeros((3, 5))
            J[:, :3] = -se3.skew(mean)
            J[:, column] = mean
            residual = first - second
            far = float(np.linalg.norm(residual - J @ self.estimate())) / sigma
            weight = min(1.0, _KNEE / max(far, 1e-9)) / sigma**2
            self.information = self.information + weight * J.T @ J
            self.gain = self.gain + weight * J.T @ residual

    def estimate(self) -> Array:
        """Returns (5,): by what turn (rad), share of way and share of turning the first sensor differs."""
        return np.asarray(np.linalg.solve(self.information, self.gain))

    def sigmas(self) -> Array:
        return np.asarray(np.sqrt(np.diag(np.linalg.inv(self.information))))


@dataclass(frozen=True)
class Contradiction:
    """Names a sensor that is contradicted: by whom, in what (`way`, `turn`, `direction`), and how far (shares, rad).

    `alone`: by two or more that agree with each other; else it is undecidable which of the two is wrong.
    """

    sensor: str
    by: tuple[str, ...]
    what: str
    size: float
    alone: bool

    def text(self) -> str:
        others = " and ".join(self.by)
        if self.what == "direction":
            return f"{self.sensor}: direction off by {np.rad2deg(self.size):.1f}° from {others}"
        name = "way" if self.what == "way" else "turning"
        return f"{self.sensor}: {abs(self.size):.1%} {'more' if self.size > 0 else 'less'} {name} than {others}"


class MotionAgreement(Remembered):
    """Compares sensors two by two, and names those that are contradicted, and by which."""

    _pairs: dict[tuple[str, str], Pair]

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._pairs = {}

    def add(self, windows: Mapping[str, Window]) -> None:
        """Takes each sensor's motion in one window."""
        for a, b in combinations(sorted(windows), 2):
            first, second = windows[a], windows[b]
            pair = self._pairs.setdefault((a, b), Pair(first.coarse or second.coarse))
            pair.add(first.twist, second.twist)

    def contradictions(self) -> list[Contradiction]:
        return [each for what in ("way", "turn", "direction") for each in self._contradicted(what)]

    def _contradicted(self, what: str) -> Iterator[Contradiction]:
        sizes = {names: self._judged(pair, what) for names, pair in self._pairs.items()}
        off = {names: size for names, size in sizes.items() if size is not None and size != 0.0}
        left = dict(off)
        for sensor in sorted({name for names in off for name in names}):
            against = [other for names in off if sensor in names for other in names if other != sensor]
            agree = not any(pair in off for pair in combinations(sorted(against), 2))
            if len(against) >= 2 and agree:
                signed = [off[n] if n[0] == sensor else -off[n] for n in off if sensor in n]
                size = abs(float(np.mean(np.abs(signed)))) if what == "direction" else float(np.mean(signed))
                yield Contradiction(sensor, tuple(against), what, size, alone=True)
                left = {names: value for names, value in left.items() if sensor not in names}
        for (a, b), size in left.items():
            yield Contradiction(a, (b,), what, size, alone=False)

    def _judged(self, pair: Pair, what: str) -> float | None:
        """The size of a pair's disagreement, 0 where there is none, None where it is unknown."""
        x, sigma = pair.estimate(), pair.sigmas()
        if what == "direction":
            k, size, limit = int(np.argmax(np.abs(x[:3]))), float(np.linalg.norm(x[:3])), self._limits.angle
        elif what == "way":
            k, size, limit = 3, float(x[3]), self._limits.way
        else:
            k, size, limit = 4, float(x[4]), self._limits.coarse_turn if pair.coarse else self._limits.turn
        spread = float(sigma[k])
        if abs(size) > limit and abs(size) > _SURE * spread:
            return size
        return 0.0 if spread < 0.5 * limit or abs(size) + spread < limit else None


class Track(Remembered):
    """Keeps the poses (4, 4) of the body by one sensor over the last seconds."""

    stamps: list[int]
    poses: list[Array]

    def __init__(self) -> None:
        self.stamps, self.poses = [], []

    def pose(self, stamp: int, T: Array) -> None:
        self.stamps.append(stamp)
        self.poses.append(T)
        while self.stamps[0] < stamp - _SPAN:
            del self.stamps[0], self.poses[0]

    def twist(self, stamp: int, velocity: Array) -> None:
        """Goes on by the mean velocity (6,) since the last pose."""
        if not self.stamps or stamp - self.stamps[-1] > _GAP:
            self.stamps, self.poses = [], []
            self.pose(stamp, np.eye(4))
        else:
            step = velocity * ((stamp - self.stamps[-1]) * 1e-9)
            self.pose(stamp, self.poses[-1] @ se3.exp(step))

    def between(self, begin: int, end: int) -> Array | None:
        """Returns the motion (6,) from one stamp to another; None where poses are missing."""
        first, last = self._at(begin), self._at(end)
        return None if first is None or last is None else se3.log(invert(first) @ last)

    def newest(self, now: int, age: int) -> Array | None:
        """Returns the mean velocity (6,) between the last two poses; None where they are older than `age` (ns)."""
        if len(self.stamps) < 2 or now - self.stamps[-1] > age or self.stamps[-1] - self.stamps[-2] > _GAP:
            return None
        motion = self.between(self.stamps[-2], self.stamps[-1])
        return None if motion is None else motion / ((self.stamps[-1] - self.stamps[-2]) * 1e-9)

    def _at(self, stamp: int) -> Array | None:
        following = int(np.searchsorted(self.stamps, stamp)) if self.stamps else 0
        if following >= len(self.stamps) or self.stamps[0] > stamp:
            return None
        if self.stamps[following] == stamp:
            return self.poses[following]
        before, after = self.stamps[following - 1], self.stamps[following]
        if after - before > _GAP:
            return None
        return se3.interpolated(self.poses[following - 1], self.poses[following], (stamp - before) / (after - before))
