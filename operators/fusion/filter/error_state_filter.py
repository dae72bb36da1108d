"""An error-state filter of measurements in any order: what comes late is put in its place and the rest is done again.

The filter keeps what it was given within a window, in the order of time, with the estimate after each. A late
measurement therefore gives the same bits as one in time.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataflow.operator import Remembered
from operators.fusion.filter.error_state import (
    POSITION,
    ROTATION,
    SIZE,
    Noise,
    State,
    difference,
    mahalanobis,
    moved,
    propagated,
    shifted,
    updated,
)
from operators.fusion.filter.gate import (
    PLACES,
    GateConfig,
    Health,
    RejectedMeasurement,
    judge,
    leap,
    repeat_of,
    threshold,
)
from operators.fusion.filter.history import Command, Entry, Hypothesis, Node, Restart, Sample
from operators.fusion.filter.hypotheses import combined, doubted, likely, moves, reduced, refuted, with_errors
from operators.fusion.filter.measurements import Measurement
from operators.fusion.filter.sensor_errors import SensorErrors
from operators.fusion.filter.suspicions import CHANCE, Suspicions

Array = NDArray[np.float64]
TOO_LATE = ": too late"
"""Suffix of a sensor's name in the counts of measurements that came after the window."""
_STANDS = 60_000_000_000
"""Nanoseconds in motion until which a refuted first heading is reported."""
_YOUNG = 1e-3
"""Probability that a filter of less than a window's age differs so much from a fit by chance."""
_MOMENT = 1e-3
"""Seconds over which the change of a prediction is taken."""
FARTHEST = 1000.0
"""Standard deviation of a first position, m: the room that is made for a place is no larger."""
UNMEASURED = FARTHEST / 2
"""Standard deviation of a coordinate (m) that nothing has measured yet: half of what it begins with."""


@dataclass(frozen=True)
class FilterConfig:
    """The rules of the filter.

    `window`: seconds for which late measurements are taken; `gravity` in m/s²; `max_gap`: seconds without an inertial
    sample after which the motion in between is unknown, with the noise `unknown`; `inertial`: there are samples at all.
    Without them velocity and angular velocity stay but for the noise `unknown`. `gates`: those of single sensors, by
    the first word of their name. `errors`: those of sensors that are estimated. `unfelt`: standard deviation (m/s²) of
    what an inertial sensor as little known as at first may fail to feel, which is what the gates grant it; None where
    there is none. `biases`: standard deviations (rad/s, m/s²) of the first biases.
    """

    window: float = 1.0
    gravity: float = 9.80665
    max_gap: float = 0.1
    inertial: bool = True
    unknown: Noise = field(default_factory=lambda: Noise(0.0, 1.0, 1.0, 0.0))
    gate: GateConfig = field(default_factory=GateConfig)
    gates: Mapping[str, GateConfig] = field(default_factory=dict)
    errors: SensorErrors = field(default_factory=SensorErrors)
    unfelt: float | None = None
    biases: tuple[float, float] = (0.02, 0.2)


class ErrorStateFilter(Remembered):
    """Takes inertial samples in order and measurements in any; several hypotheses until one has explained the rest."""

    ignored: Counter[str]
    _base: Node  # the oldest estimate of the window: the rest follows from it and what was given since
    _entries: list[Entry]
    _keys: list[tuple[int, int, str, int]]
    _count: int
    _suspicions: Suspicions
    restarted: int  # when it last began anew, ns

    def __init__(self, config: FilterConfig, start: Node) -> None:
        self._config = config
        self._down = np.array([0.0, 0.0, -config.gravity])
        self._wander = config.errors.wander
        self._base, self._entries, self._keys, self._count = start, [], [], 0
        self.ignored, self.restarted, self._suspicions = Counter(), -_STANDS, self.new_part(Suspicions)
        self.restored()

    def prepare_snapshot(self) -> None:
        self._newest()
        self._base = self._nodes[0]

    def new_part(self, kind: type[Any]) -> Suspicions:
        gravity = self._down if self._config.inertial else np.zeros(3)
        return Suspicions(self._config.errors, gravity, self._config.biases)

    def restored(self) -> None:
        self._nodes = [with_errors(self._base, self._config.errors.sigmas)]
        self._samples = [entry for entry in self._entries if isinstance(entry, Sample)]
        self._sample_times = [sample.time for sample in self._samples]
        self._advance()

    @property
    def time(self) -> int:
        """The time of the newest estimate, ns."""
        if self._config.inertial:
            return self._newest_sample()
        return self._entries[-1].time if self._entries else self._nodes[0].time

    @property
    def health(self) -> Mapping[str, Health]:
        return self._newest().health

    @property
    def hypotheses(self) -> int:
        """Returns how many headings are in question: one where it was given, until that is refuted."""
        node = self._newest()
        told = any(h.against for h in node.hypotheses) and not node.refuted
        return 1 if told else len(likely(node.hypotheses))

    @property
    def doubted_heading(self) -> bool:
        """Returns whether the given first heading may be wrong, though it is not refuted."""
        node = self._newest()
        return node.doubted and not node.refuted

    @property
    def refuted_heading(self) -> bool:
        """Returns whether recent measurements contradict the given first heading."""
        node = self._newest()
        return node.refuted and node.moving < _STANDS

    @property
    def suspicion(self) -> tuple[str, str, float, float] | None:
        """The error that a sensor was not told to have, as `Suspicions.found`."""
        return self._suspicions.found

    def look(self) -> None:
        """Fits the motion of late anew, once a second: shows errors of sensors, or that the estimate is wrong.

        An estimate that was linearised about what it is not may be sure of a wrong rotation: it begins anew at the fit.
        One that is older than the window holds more than the fit, and is looked at for hours: chance has to be rarer.
        """
        node, before = self._newest(), self.suspicion
        sure = len(likely(node.hypotheses)) == 1 and not node.refuted
        fit = self._suspicions.look(node.time, node.window, sure)
        if fit is None or fit.end is None or not sure:
            return
        key = (fit.until, 3, "", 0)
        node = self._nodes[bisect_right(self._keys, key)]
        if node.time != fit.until:
            return
        own = combined(node.hypotheses)
        off = difference(own, fit.end)[ROTATION]
        late = before is None and self.suspicion is not None  # stamps, which from now on are taken for what they are
        spread = own.covariance[ROTATION, ROTATION] + fit.end.covariance[ROTATION, ROTATION]
        chance = CHANCE if node.window.first else _YOUNG
        if late or float(off @ np.linalg.solve(spread, off)) > threshold(1 - chance, 3):
            covariance = own.covariance.copy()
            covariance[:SIZE, SIZE:], covariance[SIZE:, :SIZE] = 0.0, 0.0
            covariance[:SIZE, :SIZE] = fit.end.covariance
            self._insert(Restart(fit.until, replace(fit.end, errors=own.errors, covariance=covariance)), key)
            self.restarted = node.time

    def feel(self, sample: Sample) -> None:
        """Takes an inertial sample, later than the last one."""
        if sample.time <= (self._sample_times[-1] if self._sample_times else self._nodes[0].time):
            self.ignored["inertial sample not later than the last"] += 1
            return
        self._sample_times.append(sample.time)
        self._samples.append(sample)
        self._insert(sample, (sample.time, 0, "", 0))

    def measure(self, measurement: Measurement) -> bool:
        """Takes a measurement; False where it is too late."""
        if measurement.time < self.time - round(self._config.window * 1e9):
            self.ignored[measurement.sensor + TOO_LATE] += 1
            return False
        if measurement.time < self._nodes[0].time:
            self.ignored[f"{measurement.sensor}: before the beginning"] += 1
            return False
        self._count += 1
        self._insert(measurement, (measurement.time, 1, measurement.sensor, self._count))
        return True

    def command(self, command: Command) -> bool:
        """Takes a control input, which counts where there are no inertial samples; False where it is too late."""
        if command.time < max(self.time - round(self._config.window * 1e9), self._nodes[0].time):
            self.ignored["control input: too late"] += 1
            return False
        self._count += 1
        self._insert(command, (command.time, 2, "", self._count))
        return True

    def offsets(self) -> dict[str, tuple[float, float]]:
        """Returns the estimated time offset of each sensor that has a clock, and its standard deviation, seconds."""
        names = [name for name, _ in self._config.errors.clocks]
        if not names:
            return {}
        state = combined(self._newest().hypotheses)
        sigmas = np.sqrt(np.diag(state.covariance)[SIZE:]).tolist()
        return {name: (float(state.errors[k]), sigmas[k]) for k, name in enumerate(names)}

    def estimate(self, time: int) -> tuple[State, Array]:
        """Returns the state at a time, not before the newest entry, and the gyroscope's reading."""
        node = self._newest()
        if time > node.time:
            node = self._moved(node, time, node.gyro, node.accel, self._noise())
        return combined(node.hypotheses), node.gyro

    def _noise(self) -> Noise:
        return self._samples[-1].noise if self._samples else self._config.unknown

    def _insert(self, entry: Entry, key: tuple[int, int, str, int]) -> None:
        place = bisect_right(self._keys, key)
        self._keys.insert(place, key)
        self._entries.insert(place, entry)
        del self._nodes[place + 1 :]

    def _newest(self) -> Node:
        """The newest estimate: what came in since the last is done at once, so that none of it is done again."""
        self._advance()
        self._trim()
        return self._nodes[-1]

    def _advance(self) -> None:
        while len(self._nodes) <= len(self._entries):
            following = self._entries[len(self._nodes) - 1]
            if self._config.inertial and not isinstance(following, Sample) and following.time > self._newest_sample():
                break  # until the readings up to there are known
            self._nodes.append(self._after(self._nodes[-1], following))

    def _newest_sample(self) -> int:
        return self._sample_times[-1] if self._sample_times else self._nodes[0].time

    def _trim(self) -> None:
        """Forgets what lies before the window; in portions, since lists are cut at their beginning."""
        limit = self.time - round(self._config.window * 1e9)
        old = bisect_right(self._keys, (limit, -1, "", 0))
        if old < 64:
            return
        old = min(old, len(self._nodes) - 1)
        del self._nodes[:old], self._keys[:old], self._entries[:old]
        gone = bisect_right(self._sample_times, self._nodes[0].time)
        del self._sample_times[:gone], self._samples[:gone]

    def _after(self, node: Node, entry: Entry) -> Node:
        if isinstance(entry, Sample):
            return self._moved(node, entry.time, entry.gyro, entry.accel, entry.noise)
        if entry.time > node.time:
            if self._config.inertial:
                following = self._samples[bisect_right(self._sample_times, entry.time - 1)]
                share = (entry.time - node.time) / (following.time - node.time)
                gyro = node.gyro + share * (following.gyro - node.gyro)
                accel = node.accel + share * (following.accel - node.accel)
                noise = following.noise
            else:
                gyro, accel, noise = node.gyro, node.accel, self._config.unknown
            node = self._moved(node, entry.time, gyro, accel, noise)
        if isinstance(entry, Restart):
            return replace(node, hypotheses=(Hypothesis(0.0, entry.state),))
        if isinstance(entry, Command):
            return replace(node, command=entry)
        return self._measured(node, entry)

    def _moved(self, node: Node, time: int, gyro: Array, accel: Array, noise: Noise) -> Node:
        """Moves to a later time by the mean of the readings before and then."""
        seconds = (time - node.time) * 1e-9
        inertial = self._config.inertial
        if inertial and seconds <= self._config.max_gap:
            mean_gyro, mean_accel = 0.5 * (node.gyro + gyro), 0.5 * (node.accel + accel)
            hypotheses = tuple(
                replace(h, state=propagated(h.state, mean_gyro, mean_accel, seconds, noise, self._down, self._wander))
                for h in node.hypotheses
            )
            window = node.window.felt(mean_gyro, mean_accel, seconds, noise)
        else:
            hypotheses = tuple(replace(h, state=self._coasted(h.state, seconds, gyro, node)) for h in node.hypotheses)
            window = node.window.broken() if inertial or node.command else node.window.coasted(seconds, noise)
        moving = node.moving + (time - node.time) * moves(max(hypotheses, key=lambda h: h.weight).state)
        return replace(node, time=time, hypotheses=hypotheses, gyro=gyro, accel=accel, moving=moving, window=window)

    def _coasted(self, state: State, seconds: float, gyro: Array, node: Node) -> State:
        """Goes on at the same velocities, or those that were commanded: what is felt is gravity alone."""
        steps = max(1, math.ceil(seconds / 0.05))
        turning = gyro if self._config.inertial else np.zeros(3)
        for k in range(steps):
            force = state.accel_bias - state.rotation.T @ self._down
            before = state.rotation
            state = propagated(state, turning, force, seconds / steps, self._config.unknown, self._down, self._wander)
            if node.command is not None and not self._config.inertial:
                now = node.time + round((k + 1) / steps * seconds * 1e9)
                state = node.command.drive(state, before, now, seconds / steps)
        return state

    def _measured(self, node: Node, entry: Measurement) -> Node:
        config = self._config.gates.get(entry.sensor.partition(" ")[0], self._config.gate)
        health = node.health.get(entry.sensor, Health())
        kind = type(entry.model).__name__
        hypotheses = node.hypotheses
        found, scores, best = self._found(entry, hypotheses, node)
        state, (residual, H) = hypotheses[best].state, found[best]
        fits = scores[best][0] <= threshold(config.share, len(residual))
        if not fits and unplaced(state, kind):
            hypotheses = _brought(hypotheses, found)
            found, scores, best = self._found(entry, hypotheses, node)
        health = replace(health, repeat=repeat_of(health.repeat, entry, state, fits))
        doubt = RejectedMeasurement(entry.time, residual, entry.noise, kind)
        unfelt = self._config.unfelt
        nis = scores[best][0]
        leapt = 0.0 if unfelt is None else leap(config, entry.sensor, doubt, node.health, state, H, nis, unfelt)
        verdict = judge(config, health.doubts, doubt, state, H, nis, leapt > 0 or health.frozen, health.idle)
        after = health.after(verdict, entry.time, nis, doubt, config, leapt)
        if verdict == "widened":
            since = (entry.time - (health.last_used or self._nodes[0].time)) * 1e-9
            room = np.zeros_like(state.covariance)
            residual, beyond = bounded(residual, H)
            room[:SIZE, :SIZE] = np.diag(entry.model.widening(residual, since))
            if beyond:
                hypotheses = _brought(hypotheses, found)
                found, _, _ = self._found(entry, hypotheses, node)
            hypotheses = tuple(
                replace(h, state=replace(h.state, covariance=h.state.covariance + room)) for h in hypotheses
            )
        if verdict not in ("used", "widened"):
            hypotheses = node.hypotheses
        else:
            hypotheses = reduced(
                [
                    replace(h, weight=h.weight - 0.5 * (nis + spread), state=updated(h.state, r, J, entry.noise))
                    for h, (r, J), (nis, spread) in zip(hypotheses, found, scores, strict=True)
                ],
                node.moving,
            )
        window = node.window
        if verdict == "used":
            before = combined(node.hypotheses)
            accel = node.accel if self._config.inertial else before.accel_bias
            window = window.measured(entry, before, node.gyro, accel)
        return replace(
            node,
            hypotheses=hypotheses,
            health={**node.health, entry.sensor: after},
            refuted=refuted(hypotheses, node.refuted),
            doubted=doubted(hypotheses, node.doubted),
            window=window,
        )

    def _found(
        self, entry: Measurement, hypotheses: Sequence[Hypothesis], node: Node
    ) -> tuple[list[tuple[Array, Array]], list[tuple[float, float]], int]:
        """Returns residual and Jacobian by each hypothesis, its score, and which hypothesis fits best."""
        found = [self._innovation(entry, h.state, node) for h in hypotheses]
        scores = [mahalanobis(h.state, r, H, entry.noise) for h, (r, H) in zip(hypotheses, found, strict=True)]
        return found, scores, min(range(len(scores)), key=lambda k: scores[k][0])

    def _innovation(self, entry: Measurement, state: State, node: Node) -> tuple[Array, Array]:
        """Residual and Jacobian (M, 15 + K), without the errors that the sensor is believed to have."""
        residual, H = entry.model.innovation(state, node.gyro)
        if not len(state.errors):
            return residual, H
        J = np.zeros((len(residual), len(state.covariance)))
        J[:, :SIZE] = H
        if entry.clock >= 0:
            change = self._change(entry, state, node)
            residual = residual + change * (state.errors[entry.clock] - entry.assumed)
            J[:, SIZE + entry.clock] = -change
        return self._config.errors.taken_off(entry.sensor, entry.model, state, residual, J), J

    def _change(self, entry: Measurement, state: State, node: Node) -> Array:
        """Returns how fast the prediction of a measurement changes (M,), its unit a second."""
        acceleration = np.zeros(3)
        if self._config.inertial:
            acceleration = state.rotation @ (node.accel - state.accel_bias) + self._down
        around = [shifted(state, node.gyro - state.gyro_bias, acceleration, s * _MOMENT) for s in (-0.5, 0.5)]
        before, after = (entry.model.innovation(at, node.gyro)[0] for at in around)
        return np.asarray((before - after) / _MOMENT)


def _brought(hypotheses: Sequence[Hypothesis], found: Sequence[tuple[Array, Array]]) -> tuple[Hypothesis, ...]:
    """Returns the hypotheses, each moved to the place that was measured."""
    return tuple(replace(h, state=brought(h.state, r, H)) for h, (r, H) in zip(hypotheses, found, strict=True))


# Places beyond what is expected: doubles do not hold a variance of (10⁷ m)², so the state is brought there first.


def unplaced(state: State, kind: str) -> bool:
    """Returns whether a measurement by a model of this name is the first that places the body."""
    return kind in PLACES and bool((np.diag(state.covariance)[POSITION][:2] >= UNMEASURED**2).all())


def brought(state: State, residual: Array, H: Array) -> State:
    """Returns the state moved to the measured place, with the covariance that it had."""
    error = np.zeros(len(state.covariance))
    error[POSITION] = H[:, POSITION].T @ residual
    return moved(state, error)


def bounded(residual: Array, H: Array) -> tuple[Array, bool]:
    """Returns the residual for which room is made, shortened to FARTHEST, and whether it was longer."""
    places = H[:, POSITION].any(axis=1)
    length = float(np.linalg.norm(residual[places]))
    if length <= FARTHEST:
        return residual, False
    return np.where(places, residual * (FARTHEST / length), residual), True
